"""Nothing stays on the CPU when the networks live elsewhere: the stages' mathematics on torch's device "meta".

It holds no numbers, but refuses to add or join its tensors with the CPU's, as a GPU would.
"""

from contextlib import nullcontext
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn as nn

import aib_belief
import aib_repr
import ppo_aib
import ppo_baseline
import ppo_believer
import toy
from conftest import TOY, spaces

IMAGE, J, A, U, T, B = [36, 36, 3], 3, 2, 4, 10, 3
CONFIG = {"image_shape": IMAGE, "joints_dim": J, "u_dim": U, "z_dim": 5}


@pytest.fixture(autouse=True)
def meta(monkeypatch: pytest.MonkeyPatch) -> None:
    """What "meta" lacks: autocast, and numbers to act with."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    monkeypatch.setattr(torch.Tensor, "cpu", lambda x: torch.zeros(x.shape, dtype=x.dtype))


def random(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, device="meta")


def images(*shape: int) -> torch.Tensor:
    return torch.zeros(*shape, *IMAGE, dtype=torch.uint8, device="meta")


def test_the_device_tells_the_cpu_apart() -> None:
    for join in (torch.add, lambda x, y: torch.cat([x, y])):
        with pytest.raises(RuntimeError):
            join(random(2), torch.zeros(2))


def test_stage_1() -> None:
    model = nn.ModuleDict({"phi": aib_repr.StateEncoder(7, U), "psi": aib_repr.ObservationEncoder(IMAGE, J, U)})
    model["g"] = aib_repr.Predictor(U, A)
    batch = {"rgb": images(B), "joints": random(B, J), "state": random(B, 7)}
    batch |= {f"next_{name}": x for name, x in batch.items()} | {"actions": random(B, A), "rewards": random(B)}
    losses = aib_repr.repr_losses(model.to("meta"), batch, aib_repr.Args())
    losses["total"].backward()
    assert {x.device.type for x in losses.values()} == {"meta"}


@pytest.mark.parametrize("head", ["flow", "mse", "none", "believer"])
def test_stage_2(head: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the images in chunks, and the warm-up, too."""
    module = ppo_believer if head == "believer" else aib_belief
    monkeypatch.setattr(module, "IMAGE_CHUNK", 20)
    belief = ppo_believer.BelieverBelief(CONFIG) if head == "believer" else aib_belief.AIBBelief(CONFIG)
    model = nn.ModuleDict({"belief": belief, "posterior": module.GaussianMLP(U + 256, [8], 5, min_std=0.1)})
    if head in ("flow", "mse"):
        model["head"] = module.mlp([10 + (A + 1) * (head == "flow"), 8, A])
    model["teacher"] = module.Teacher(U)
    model.to("meta")
    args = module.Args(z_dim=5, warmup_updates=1, prior_nll=1.0)
    if head != "believer":
        args.action_head = head
    frames = {"rgb": images(B), "u": random(B, U), "u_0": random(B, U), "t": random(B)}
    module.warmup_loss(model, frames, args).backward()
    batch = {"rgb": images(T + 1, B), "joints": random(T + 1, B, J), "u": random(T + 1, B, U)}
    batch["actions"] = random(T, B, A)
    if head == "believer":
        losses = module.believer_losses(model, batch, args)
    else:
        losses = module.belief_losses(model, batch, args)
    losses["total"].backward()
    held_out = module.validate_belief(belief, lambda index: batch, np.arange(B))
    assert {x.device.type for x in (*losses.values(), *held_out)} == {"meta"}


@pytest.mark.parametrize("module", [ppo_aib, ppo_believer, ppo_baseline])
def test_ppo(module: ModuleType) -> None:
    if module is ppo_baseline:
        agent, play = module.Agent(spaces(IMAGE, J, A), module.Args()), module.rollout
    else:
        belief = ppo_aib.AIBBelief(CONFIG) if module is ppo_aib else module.BelieverBelief(CONFIG)
        agent, play = module.Agent(spaces(IMAGE, J, A), belief, module.Args()), module.rollout
    args = module.Args(env_id=TOY, device="meta")
    data = play(toy.make_envs(SimpleNamespace(num_workers=2)), agent.to("meta"), args, np.arange(B))
    values = data.pop("values")
    data["advantages"] = module.compute_gae(data["rewards"], values, args.gamma, args.gae_lambda)
    data["returns"] = data["advantages"] + values[:-1]
    losses = module.ppo_losses(agent, {name: x.flatten(0, 1) for name, x in data.items()}, args)
    losses["total"].backward()
    assert {x.device.type for x in (*data.values(), *losses.values())} == {"meta"}
