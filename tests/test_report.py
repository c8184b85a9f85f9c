"""The benchmark's commands and its report, on numbers one can check by hand, and the pages that it makes."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pandas as pd
import pytest
import tyro

from conftest import ROOT, SCRIPTS

sys.path.append(str(ROOT / "benchmark"))
import belief
import diagnose_agent
import report

TASK = "RememberShapeAndColor3x2-v0"


def record(
    runs: Path, exp_name: str, seed: int, success_once: list[float], quick: bool = False, task: str = TASK
) -> None:
    """A run directory with as many evaluations; success_at_end is half of success_once."""
    path = runs / f"{task}__{exp_name}__{seed}"
    path.mkdir(parents=True)
    (path / "args.json").write_text(json.dumps({"env_id": task, "exp_name": exp_name, "seed": seed, "quick": quick}))
    lines = ["iteration,global_step,success_once,success_at_end,return"]
    lines += [f"{i},{1000 * i},{value},{value / 2},3.5" for i, value in enumerate(success_once, 1)]
    (path / "eval.csv").write_text("\n".join(lines) + "\n")


def test_report_against_numbers_computed_by_hand(tmp_path: Path) -> None:
    for seed, values in ((1, [0.9, 0.5, 0.6, 0.7]), (2, [0.1, 0.4, 0.5, 0.6]), (3, [0.0, 0.7, 0.8, 0.9])):
        record(tmp_path, "ppo_aib", seed, values)
    record(tmp_path, "ppo_baseline", 1, [0.0, 0.1, 0.3])
    record(tmp_path, "published_ppo", 1, [0.25])
    record(tmp_path, "ppo_believer_quick", 1, [1.0], quick=True)
    belief = {"cue_from_h": [0.0] * 60 + [0.9], "cue_from_particle": [0.5] * 61, "u_r2_prior": [0.25] * 61}
    belief |= {"nll_prior": -3.0, "nll_posterior": -4.0, "action_readout": 0.5}
    path = tmp_path / f"{TASK}__aib_belief__1"
    path.mkdir()
    arguments = {"env_id": TASK, "exp_name": "aib_belief", "seed": 1, "action_head": "none", "quick": False}
    (path / "args.json").write_text(json.dumps(arguments))
    (path / "diagnostics.json").write_text(json.dumps(belief))
    report.main(report.Args(runs=tmp_path, output=tmp_path / "report"))
    text = (tmp_path / "report" / "report.md").read_text()
    # last three: 0.6, 0.5, 0.8: mean 0.6333; maxima 0.9, 0.6, 0.9
    aib = "0.63 ± 0.15 | 0.80 ± 0.17"
    assert f"| success_once | ppo_aib, 4,000 steps | {aib} |" in text
    assert "| success_at_end | ppo_aib, 4,000 steps | 0.32 ± 0.08 |" in text
    assert "| success_once | ppo_baseline, 3,000 steps | 0.13 | 0.30 |" in text
    assert "| success_once | published_ppo, 1,000 steps | 0.25 | 0.25 |" in text
    assert "| success_once | AIB, the paper's | 0.82 ± 0.04 | 0.87 ± 0.01 |" in text
    assert "| 0.25 | 0.25 | 0.25 | 0.25 |  |  | 0.90 | 0.50 | 0.50 | -3.00 | -4.00 |  |" in text
    assert "quick" not in text and "average" not in text
    record(tmp_path, "ppo_aib", 1, [0.4], task="InterceptFast-v0")
    report.main(report.Args(runs=tmp_path, output=tmp_path / "report"))
    text = (tmp_path / "report" / "report.md").read_text()
    assert "| ppo_aib | InterceptFast, RememberShapeAndColor3x2 | 0.50 | 0.25 |" in text, "seed 1 alone has both"
    assert iio.imread(tmp_path / "report" / "learning_curves.png").std() > 10


def test_runs_are_added_to_the_results_and_tabled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = tmp_path / "runs"
    for seed, shift in ((1, -0.2), (11, 0.0), (12, 0.1), (13, 0.2)):
        record(runs, "ppo_aib_small", seed, [0.25, 0.5 + shift])
        record(runs, "ppo_believer_small", seed, [0.25, 0.5])
        for name, once in (("ppo_aib_small", 0.6 + shift), ("ppo_believer_small", 0.5)):
            path = runs / f"{TASK}__{name}__{seed}"
            test = {"global_step": 2000, "success_once": once, "success_at_end": once / 2, "num_eval_episodes": 256}
            (path / "evaluation.json").write_text(json.dumps(test))
    (path / "diagnosis.json").write_text('{"nearest_is_right": 0.75, "u_r2": {"0": 1.0, "5": 0.5}}')
    (path / "diagnosis_swapped.json").write_text('{"success_once": 0.125}')
    stage_1 = runs / f"{TASK}__aib_repr_small__13"
    stage_1.mkdir()
    (stage_1 / "args.json").write_text('{"num_episodes": 100, "quick": true}')
    for wanted, more in ((6000, {"belief": None, "small": True}), (0, {"belief": None}), (0, {"small": True})):
        assert report.steps_before({"env_id": TASK, "seed": 13, **more}, runs) == wanted, "episodes of 60 steps"
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    (tmp_path / "paper.csv").write_text((ROOT / "benchmark" / "results" / "paper.csv").read_text())
    for name, columns in report.COLUMNS.items():
        (tmp_path / name).write_text(",".join([*report.RUN, "step", *columns]) + "\n")
    with pytest.raises(SystemExit):
        report.main(report.Args(runs=runs, add=True))
    for command in (["init", "-q"], ["-c", "user.name=x", "-c", "user.email=x", "commit", "-qm", "x", "--allow-empty"]):
        subprocess.run(["git", "-C", str(tmp_path), *command], check=True)
    report.main(report.Args(runs=runs, add=True))
    report.main(report.Args(runs=runs, add=True))  # a second time in place of the first
    before = (tmp_path / "eval.csv").read_text()
    first = tmp_path / "first" / f"{TASK}__ppo_aib_small__1"
    shutil.copytree(runs / first.name, first)
    report.main(report.Args(runs=first.parent, add=True))
    assert (tmp_path / "eval.csv").read_text() == before, "older runs stay before newer ones"
    commit = subprocess.run(["git", "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, cwd=runs).stdout
    tests, beliefs = (tmp_path / "test.csv").read_text().splitlines(), report.read("beliefs.csv")
    run = f"{TASK},ppo_believer_small,13,{commit.strip()},"
    assert len(tests) == 1 + 8 and tests[-1] == f"{run}2000,0.5000,0.2500,,0.7500,0.1250"
    assert len(report.read("eval.csv")) == 16 and [*beliefs.metric] == ["u_r2_agent"] * 2
    evals, tests = report.read("eval.csv"), report.read("test.csv")
    # seed 1 is left out: 0.6, 0.7, 0.8 and 0.3, 0.35, 0.4; the paper's of RememberShapeAndColor3x2
    cells = "0.70 ± 0.10 / 0.35 ± 0.05 | 0.50 ± 0.00 / 0.25 ± 0.00 |  |  | 11, 12, 13 | 0.82 / 0.81 |"
    assert f"| RememberShapeAndColor3x2 | 0.17 | {cells}" in report.results_table(tests)
    # differences 0.1, 0.2, 0.3: standard error 0.0577, t of two degrees of freedom 4.303
    assert "| 3 | +0.20 [-0.05, +0.45] | +0.10 [-0.02, +0.22] |" in report.pairs_table(tests)
    equal = tests[tests.exp_name == "ppo_believer_small"].assign(exp_name="ppo_baseline_equal")
    # of the 20 ways to label 0.6, 0.7, 0.8 and 0.5 three times, one has a difference as large as 0.2
    plain = report.plain_table(pd.concat([tests, equal]))
    p = float(re.search(r"\| AIB \| 1 \| \+0.20, p = ([0-9.]+) \|", plain).group(1))
    assert p == pytest.approx(1 / 20, abs=0.01)
    both = pd.concat([tests, tests.assign(task="InterceptFast-v0")])
    # the mean of two means of 0.1, 0.2, 0.3: 95 % of the bootstrap's lie within 0.2 +- 1.96 * sqrt(0.02 / 3 / 3 / 2)
    low, high = re.search(
        r"\| mean over tasks \| 6 \| \+0.20 \[\+([0-9.]+), \+([0-9.]+)\]", report.pairs_table(both)
    ).groups()
    assert float(low) == pytest.approx(0.135, abs=0.02) and float(high) == pytest.approx(0.265, abs=0.02)
    table = report.runs_table(evals, tests)
    assert f"| Believer | 13 | {commit.strip()} | 2,000 | 0.38 | 0.19 | 0.50 | 0.25 | 0.75 | 0.12 |" in table
    before = report.results_table(tests[tests.seed == 1])
    assert "| 0.40 / 0.20 | 0.50 / 0.25 |  |  | 1 |" in before, "until a block is finished"
    seeds = pd.DataFrame({"task": "RememberColor9-v0", "seed": [1, 12, 13, 14, 15]})
    assert [*report.of_blocks(seeds).seed] == [12, 13, 15], "14 has helped to choose the network"


def test_pages_and_figures_are_those_of_the_data(tmp_path: Path) -> None:
    for folder in ("docs", "benchmark/results"):
        (tmp_path / folder).mkdir(parents=True)
    report.rebuild(tmp_path)
    for page in ("README.md", "docs/results.md"):
        assert (tmp_path / page).read_text() == (ROOT / page).read_text(), f"python benchmark/report.py changes {page}"
    for name in ("learning_curves.png", "beliefs.png", "particles.png"):
        made, kept = (iio.imread(root / "benchmark" / "results" / name) for root in (tmp_path, ROOT))
        assert np.array_equal(made, kept), f"python benchmark/report.py changes {name}"


def test_rows_of_the_results_are_unique_and_have_a_commit() -> None:
    for name in report.COLUMNS:
        rows = report.read(name)
        key = [*report.RUN, "step", *(["metric"] if name == "beliefs.csv" else [])]
        assert not rows.duplicated(key).any() and rows.commit.notna().all()


def test_nothing_to_report(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stop:
        report.main(report.Args(runs=tmp_path, output=tmp_path / "out"))
    assert stop.value.code == 2 and "--runs" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_every_command_of_the_matrix_is_one_the_scripts_accept() -> None:
    scripts = {f"{name}.py": __import__(name).Args for name in SCRIPTS}
    scripts |= {"benchmark/belief.py": belief.Args, "benchmark/diagnose_agent.py": diagnose_agent.Args}
    for flags in ([], ["--small", "--delete-pictures", "--seeds", "11"]):
        experiment = [sys.executable, str(ROOT / "benchmark" / "experiments.py"), *flags]
        printed = subprocess.run(experiment, capture_output=True, text=True)
        assert printed.returncode == 0
        lines = [line.partition("|| ")[2] or line for line in printed.stdout.splitlines()]
        made = set()
        for line in lines:
            if line.startswith(("rm", "{ mkdir")):
                continue
            python, script, *words = shlex.split(line)
            args = tyro.cli(scripts[script], args=words)
            if script.startswith("benchmark"):
                assert str(args.run if script == "benchmark/belief.py" else args.checkpoint.parent) in made
                continue
            size = "_small" if args.small else ""
            if script == "ppo_aib.py":
                default = f"runs/{args.env_id}__aib_belief{size}__{args.seed}/belief.pt"
                assert str(Path(args.belief or default).parent) in made
            name = args.exp_name if args.exp_name != scripts[script].exp_name else script.removesuffix(".py") + size
            made.add(f"runs/{args.env_id}__{name}__{args.seed}")
        assert len(made) == (3 * (4 * 5 + 4 * 2) if not flags else 4 * 6 + 4 * 2)
