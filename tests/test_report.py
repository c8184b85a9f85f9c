"""The benchmark's commands and its report, on small recorded runs with numbers one can check by hand."""

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import tyro

from conftest import ROOT, SCRIPTS

sys.path.append(str(ROOT / "benchmark"))
import experiments
import report
import u_geometry

RECORDED = Path(__file__).parent / "recorded"


def test_tables_against_numbers_computed_by_hand(tmp_path: Path) -> None:
    report.main(report.Args(runs=RECORDED, output=tmp_path))
    text = (tmp_path / "report.md").read_text()
    tables = {part.split(":")[0]: part.splitlines() for part in text.split("## ")[1:]}
    row = next(line for line in tables["Table 1"] if line.startswith("| RSC3x2"))
    # last three: 0.6, 0.5, 0.8: mean 0.6333, sample deviation 0.1528; interquartile mean weighs them 1/6, 4/6, 1/6
    assert "| 0.63 ± 0.15 (3 seeds), IQM 0.62 [0.50, 0.80] | 0.82 ± 0.04 |" in row
    assert "| 0.50 (1 seed) | 0.76 ± 0.02 |" in row
    assert "| seed 1 unfinished (33%): 0.05 | 0.04 ± 0.02 |" in row
    assert next(line for line in tables["Table 1"] if line.startswith("| RC9")).count("missing") == 3
    row = next(line for line in tables["Table 6"] if line.startswith("| RSC3x2"))
    assert "| 0.41 ± 0.16 (3 seeds)" in row  # 1/3, 0.3, 0.6: mean 0.4111, deviation 0.1644
    row = next(line for line in tables["Table 7"] if line.startswith("| RSC3x2"))
    assert "| 0.80 ± 0.17 (3 seeds)" in row  # 0.9, 0.6, 0.9
    row = next(line for line in tables["Table 8"] if line.startswith("| RSC3x2"))
    assert "| 0.53 ± 0.06 (3 seeds)" in row  # 0.5, 0.5, 0.6
    assert "| λ = 1 | 0.40 (1 seed) | 0.666 ± 0.072 |" in text and "| λ = 0.1 | 0.20 (1 seed) | 0.623 ± 0.081 |" in text
    assert "| λ = 0.01 | missing | 0.446 ± 0.011 |" in text
    assert "| MSE regression | seed 1 is a --quick trial | only a figure |" in text
    for figure in ("figure_2.png", "figure_3.png", "figure_4.png", "figure_8.png"):
        assert iio.imread(tmp_path / figure).std() > 10


def test_small_runs_of_any_task(tmp_path: Path) -> None:
    for seed, name in ((1, "ppo_aib"), (2, "ppo_aib"), (3, "ppo_aib"), (1, "ppo_aib_refreshed")):
        run = tmp_path / f"X-v0__{name}_small__{seed}"
        shutil.copytree(RECORDED / f"RememberShapeAndColor3x2-v0__ppo_aib__{seed}", run)
        args = json.loads((run / "args.json").read_text())
        (run / "args.json").write_text(json.dumps({**args, "env_id": "X-v0", "exp_name": f"{name}_small"}))
    for seed, cue in ((1, 0.5), (2, 0.7)):
        run = tmp_path / f"X-v0__aib_belief_small__{seed}"
        run.mkdir()
        (run / "args.json").write_text(
            json.dumps({"env_id": "X-v0", "action_head": "mse", "num_episodes": 9, "num_updates": 1000, "note": "wet"})
        )
        lists = {name: [0.0] * 40 + [cue] for name in ("cue_from_h", "cue_from_particle", "u_r2_prior")}
        numbers = dict.fromkeys(("cue_chance", "nll_prior", "nll_posterior", "action_readout"), 2 * cue)
        (run / "diagnostics.json").write_text(json.dumps(lists | numbers))
    report.main(report.Args(runs=tmp_path, output=tmp_path, small=True))
    text = (tmp_path / "small.md").read_text()
    values = "0.63 ± 0.15 (3 seeds), IQM 0.62 [0.50, 0.80]"
    assert (
        f"| X-v0 | success_once, mean of the last three | {values} | missing | missing |" in text
        and iio.imread(tmp_path / "small.png").std() > 10
    )
    assert "| X-v0 | the first of these, belief refreshed (refresh.py) | 0.60 (1 seed) | – | – |" in text
    by_step = "0.00 ± 0.00 / 0.00 ± 0.00 / 0.00 ± 0.00 / 0.60 ± 0.14"
    row = ["AIB, MSE regression, 9 episodes, 1,000 updates, wet", "2", *[by_step] * 3, *["1.20 ± 0.28"] * 3, "–", "–"]
    assert "| " + " | ".join(row) + " |" in text
    assert iio.imread(tmp_path / "belief.png").std() > 10


def test_interquartile_mean() -> None:
    assert report.interquartile_mean([0.0, 1.0, 2.0, 100.0]) == 1.5
    assert report.interquartile_mean([1.0, 2.0, 9.0]) == pytest.approx((0.25 * 1 + 1 * 2 + 0.25 * 9) / 1.5)


def test_nothing_to_report(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stop:
        report.main(report.Args(runs=tmp_path, output=tmp_path / "out"))
    assert stop.value.code == 2 and "--runs" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_every_command_of_the_matrix_is_one_the_scripts_accept() -> None:
    printed = subprocess.run(
        [sys.executable, str(ROOT / "benchmark" / "experiments.py"), "--dry-run"], capture_output=True, text=True
    )
    lines = printed.stdout.splitlines()
    assert printed.returncode == 0 and len(lines) == 12 + (12 + 12) + (36 + 12) == len(set(lines))
    modules = {f"{name}.py": __import__(name) for name in SCRIPTS}
    made = set()
    for line in lines:
        python, script, *words = shlex.split(line)
        args = tyro.cli(modules[script].Args, args=words)
        name = f"runs/{args.env_id}__{args.exp_name}__{args.seed}"
        if script == "ppo_aib.py":
            assert args.belief.format(**vars(args)) in made
        made |= {name + "/belief.pt"} if script == "aib_belief.py" else {name}
    assert len(experiments.commands(experiments.Args(ablations=False))[3]) == 36


def test_u_geometry_tells_one_code_for_all_cues_from_one_for_each() -> None:
    rng = np.random.default_rng(0)
    cue, target = rng.integers(3, size=(900, 1)).astype(float), rng.normal(size=(900, 3))
    slots = np.eye(3)[cue[:, 0].astype(int)][:, :, None] * target[:, None]  # a position per object, zeros but for one
    state = np.concatenate([cue, slots.reshape(900, 9)], 1)
    shared = u_geometry.describe(state, cue, target @ rng.normal(size=(3, 4)), 600)
    separate = u_geometry.describe(state, cue, slots.reshape(900, 9) @ rng.normal(size=(9, 9)), 600)
    assert shared["share_target"] == pytest.approx(1, abs=0.01) and shared["target_error_cm"] < 1
    assert separate["share_target"] < 0.5 and separate["share_target_x_cue"] == pytest.approx(1, abs=0.01)
