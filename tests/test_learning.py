"""The real scripts learn what needs memory, on a toy task that plain PPO cannot solve."""

import json
from pathlib import Path
from types import ModuleType

import pytest

import aib_belief
import aib_repr
import ppo_aib
import ppo_baseline
import ppo_believer
import toy

STAGES = {"aib_repr": aib_repr, "aib_belief": aib_belief}
METHODS = {"ppo_aib": ppo_aib, "ppo_believer": ppo_believer, "ppo_baseline": ppo_baseline}
REPR = dict(num_episodes=300, epochs=12, batch_size=100, learning_rate=1e-3)
BELIEF = dict(num_updates=200, batch_episodes=24, belief_lr=1e-3, held_out_every=50)
PPO = dict(total_timesteps=64 * 10 * 30, num_envs=64, learning_rate=1e-3, num_minibatches=8, update_epochs=4)
PPO |= dict(eval_every=5, num_eval_episodes=192, ent_coef=0.0)


@pytest.fixture(autouse=True)
def toy_task(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Let every script play the toy task in a folder of its own."""
    for module in (*STAGES.values(), *METHODS.values()):
        if hasattr(module, "make_envs"):
            monkeypatch.setattr(module, "make_envs", toy.make_envs)
    monkeypatch.chdir(tmp_path)


def train(module: ModuleType, **arguments: object) -> Path:
    """Run a script's main on the toy task; its run directory."""
    args = module.Args(env_id="ToyMemory-v0", **arguments)
    module.main(args)
    return Path("runs") / f"ToyMemory-v0__{args.exp_name}__{args.seed}"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_belief_solves_what_plain_ppo_cannot(seed: int) -> None:
    train(aib_repr, seed=seed, **REPR)
    belief = json.loads((train(aib_belief, seed=seed, **BELIEF) / "diagnostics.json").read_text())
    assert belief["cue_from_particle"][-1] > 0.95
    success = {}
    for name, module in METHODS.items():
        path = train(module, seed=seed, **PPO, **(BELIEF if name == "ppo_believer" else {}))
        success[name] = json.loads((path / "summary.json").read_text())["success_once"]["last_three_mean"]
    print(success)
    assert success["ppo_aib"] >= 0.9 and success["ppo_believer"] >= 0.9, success
    assert abs(success["ppo_baseline"] - 1 / 3) <= 0.1, success
