"""The real scripts learn what needs memory, on a toy task that plain PPO cannot solve."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import aib_belief
import aib_repr
from conftest import ROOT, SCRIPTS, train

sys.path.append(str(ROOT / "benchmark"))
import belief as probes  # noqa: E402

REPR = dict(num_episodes=300, epochs=12, batch_size=100, learning_rate=1e-3, num_workers=100)
BELIEF = dict(num_updates=200, batch_episodes=16, belief_lr=1e-3)
PPO = dict(total_timesteps=64 * 10 * 12, num_envs=64, learning_rate=1e-3, num_minibatches=8, update_epochs=4)
PPO |= dict(eval_every=3, num_eval_episodes=192, ent_coef=0.0, num_workers=64)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in (2, 3))])
def test_belief_solves_what_plain_ppo_cannot(toy_task: Path, seed: int) -> None:
    train(aib_repr, seed=seed, **REPR)
    belief = train(aib_belief, seed=seed, **BELIEF)
    probes.main(probes.Args(belief))
    belief = json.loads((belief / "diagnostics.json").read_text())
    assert belief["cue_from_particle"][-1] > 0.95
    success = {}
    for name in ("ppo_aib", "ppo_believer", "ppo_baseline"):
        more = {"ppo_aib": {}, "ppo_believer": BELIEF, "ppo_baseline": {}}[name]
        path = train(SCRIPTS[name], seed=seed, **PPO, **more)
        rows = list(csv.DictReader((path / "eval.csv").open()))
        success[name] = np.mean([float(row["success_once"]) for row in rows[-3:]])
    print(success)
    assert success["ppo_aib"] >= 0.9 and success["ppo_believer"] >= 0.9, success
    assert abs(success["ppo_baseline"] - 1 / 3) <= 0.1, success
