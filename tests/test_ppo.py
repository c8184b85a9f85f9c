"""Stage 3 and the baselines on the toy task: what an iteration is made of, and that it depends on nothing else."""

import csv
import weakref
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

import aib_repr
import ppo_aib
import ppo_baseline
import ppo_believer
import toy

TASK = "ToyMemory-v0"
METHODS = {"ppo_aib": ppo_aib, "ppo_believer": ppo_believer, "ppo_baseline": ppo_baseline}
SMALL = dict(env_id=TASK, total_timesteps=160, num_envs=8, update_epochs=2, gamma=0.99, num_minibatches=4, eval_every=1)
SMALL |= dict(num_eval_episodes=6)


@pytest.fixture(autouse=True)
def toy_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every script play the toy task."""
    for module in (aib_repr, *METHODS.values()):
        monkeypatch.setattr(module, "make_envs", toy.make_envs)


def arguments(module: ModuleType, toy_stages: Path, **changes: object) -> object:
    """Arguments of a small run of a method on the toy stages of conftest."""
    more = {"belief": toy_stages / f"{TASK}__aib_belief__1" / "belief.pt"} if module is ppo_aib else {}
    if module is ppo_believer:
        more = {"repr_dir": toy_stages / f"{TASK}__aib_repr__1", "num_updates": 3, "batch_episodes": 4}
    return module.Args(**{**SMALL, **more, **changes})


def played(toy_stages: Path, explore: bool = True, **changes: object) -> tuple:
    """An AIB agent and what it gathered in one iteration of the toy task."""
    args = ppo_aib.resolve(arguments(ppo_aib, toy_stages, **changes), ppo_aib.PPO_DEFAULTS)
    stored = torch.load(args.belief, weights_only=True)
    envs = toy.make_envs(args, 8)
    agent, play, _ = ppo_aib.build_aib(args, envs, stored)
    return args, agent, ppo_aib.gather(play(np.arange(8), explore), 10, 8)


def test_the_ratio_starts_at_one_because_the_particles_are_kept(toy_stages: Path) -> None:
    args, agent, data = played(toy_stages)
    batch = {name: x[: len(data["reward"])].flatten(0, 1) for name, x in data.items()}

    def ratio(particles: torch.Tensor) -> torch.Tensor:
        policy, _ = agent({**batch, "particles": particles})
        return (policy.log_prob(batch["action"]).sum(-1) - batch["logprob"]).exp()

    assert torch.allclose(ratio(batch["particles"]), torch.ones(80), atol=1e-5)

    stored = torch.load(args.belief, weights_only=True)
    belief = ppo_aib.AIBBelief(stored["config"])
    belief.load_state_dict(stored["weights"])
    h, _ = belief.history(data)
    fresh = belief.particles(h, torch.randn(10, 8, 30, 32), torch.randn(10, 8, 30, 16)).flatten(0, 1)
    assert torch.allclose(fresh.mean(-2), batch["particles"].mean(-2), atol=1.0), "draws from the same belief"
    assert (ratio(fresh) - 1).abs().max() > 1e-4, "fresh draws would not do"


def test_amp_changes_the_belief_by_rounding_only(toy_stages: Path) -> None:
    (_, _, exact), (_, _, rounded) = (played(toy_stages, amp=amp) for amp in (False, True))
    first = [data["particles"][0] for data in (exact, rounded)]  # later steps see other images
    assert first[1].dtype == torch.float32
    assert not torch.equal(*first) and torch.allclose(*first, atol=0.05)


def test_rollout_arrays(toy_stages: Path) -> None:
    _, _, data = played(toy_stages)
    shapes = {name: (tuple(x.shape), x.dtype) for name, x in data.items()}
    assert shapes == {
        "rgb": ((10, 8, 36, 36, 3), torch.uint8),
        "joints": ((10, 8, 3), torch.float32),
        "particles": ((10, 8, 30, 16), torch.float32),
        "action": ((10, 8, 2), torch.float32),
        "logprob": ((10, 8), torch.float32),
        "value": ((11, 8), torch.float32),
        "reward": ((10, 8), torch.float32),
        "success": ((10, 8), torch.float32),
    }


def test_the_last_rollout_is_gone_when_the_next_begins(
    toy_stages: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    gather, images = ppo_baseline.gather, []

    def watched(*args: object) -> dict:
        assert all(image() is None for image in images)
        data = gather(*args)
        images.append(weakref.ref(data["rgb"]))
        return data

    monkeypatch.setattr(ppo_baseline, "gather", watched)
    ppo_baseline.main(arguments(ppo_baseline, toy_stages))
    assert len(images) == 2


def test_images_of_the_default_intercept_rollout_fit_in_1_2_gb() -> None:
    step = {"t": 0, "index": slice(0, 256), "rgb": torch.zeros(256, 128, 128, 3, dtype=torch.uint8)}
    data = ppo_aib.gather(iter([step]), 90, 256)
    assert data["rgb"].nbytes == 90 * 256 * 128 * 128 * 3 < 1.2e9


@pytest.mark.parametrize("target_kl, steps", [(-1.0, 0), (1e9, 2 * 4)])
def test_the_update_ends_at_the_kl_target(toy_stages: Path, target_kl: float, steps: int) -> None:
    args, agent, data = played(toy_stages)
    args.target_kl, taken = target_kl, []
    optimizer = torch.optim.SGD(agent.parameters(), lr=1e-3)
    optimizer.register_step_post_hook(lambda *_: taken.append(1))
    losses = ppo_aib.ppo_update(agent, optimizer, data, args, SimpleNamespace(received=False))
    assert len(taken) == steps and abs(losses["approx_kl"]) < 1


def test_belief_is_frozen_and_the_aggregator_learns(
    toy_stages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for script, name in (("ppo_aib", "aib_belief"), ("ppo_believer", "ppo_believer")):
        module = METHODS[script]
        module.main(arguments(module, toy_stages))
        trained = torch.load(f"runs/{TASK}__{script}__1/agent.pt", weights_only=True)
        folder = toy_stages if script == "ppo_aib" else Path("runs")
        before = torch.load(folder / f"{TASK}__{name}__1" / "belief.pt", weights_only=True)["weights"]
        assert all(torch.equal(trained["weights"][key], value) for key, value in before.items())
        module.seed_everything(1)
        start = module.BeliefAgent([36, 36, 3], 3, 2, 16).state_dict()
        for part in ("w_enc.0.weight", "w_agg.2.weight", "cnn.conv.0.weight", "actor.2.weight", "log_std"):
            assert not torch.equal(trained["agent"][part], start[part]), part


@pytest.mark.parametrize("script", METHODS)
def test_any_number_of_workers_gives_the_same_training_and_evaluation(
    toy_stages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str
) -> None:
    monkeypatch.chdir(tmp_path)
    results = {}
    for workers in (1, 2, 4):
        args = arguments(METHODS[script], toy_stages, num_workers=workers, exp_name=f"workers_{workers}")
        METHODS[script].main(args)
        path = Path("runs") / f"{TASK}__workers_{workers}__1"
        rows = list(csv.DictReader((path / "eval.csv").open()))
        results[workers] = torch.load(path / "agent.pt", weights_only=True)["agent"], rows
    for workers in (2, 4):
        for name, value in results[1][0].items():
            assert torch.allclose(value, results[workers][0][name], atol=1e-5), name
        for one, other in zip(results[1][1], results[workers][1], strict=True):
            assert one.keys() == other.keys()
            assert all(float(one[name]) == pytest.approx(float(other[name]), abs=1e-4) for name in one)
    assert len(results[1][1]) == 3, "before, between and after the two iterations"


def test_orthogonal_initialisation() -> None:
    agent = ppo_baseline.Agent([36, 36, 3], 3, 2)
    for layer, gain in ((agent.joints, 2**0.5), (agent.actor[2], 0.01 * 2**0.5), (agent.critic[2], 1.0)):
        gram = layer.weight @ layer.weight.T if layer.weight.shape[0] <= layer.weight.shape[1] else None
        gram = layer.weight.T @ layer.weight if gram is None else gram
        assert torch.allclose(gram, gain**2 * torch.eye(len(gram)), atol=1e-4) and (layer.bias == 0).all()
    assert torch.allclose(agent.log_std, torch.tensor(-0.5))


def test_table_5() -> None:
    tasks = {"RememberShapeAndColor3x2-v0": (10_380_000, 200, 4, 0.95), "RememberColor9-v0": (10_380_000, 200, 2, 0.95)}
    tasks |= {"InterceptMedium-v0": (10_000_000, 256, 2, 0.99), "InterceptFast-v0": (10_000_000, 256, 2, 0.99)}
    for task, values in tasks.items():
        args = ppo_aib.resolve(ppo_aib.Args(env_id=task), ppo_aib.PPO_DEFAULTS | ppo_aib.TASKS.get(task, {}))
        assert (args.total_timesteps, args.num_envs, args.update_epochs, args.gamma) == values
        common = (args.learning_rate, args.gae_lambda, args.ent_coef, args.target_kl, args.num_minibatches)
        assert common == (1e-4, 0.9, 0.001, 0.05, 32)
