"""The benchmark's commands and its report, on numbers one can check by hand, and the pages that it makes."""

import json
import shlex
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
    assert "| AIB, no head | aib_belief | 1 |  |  | 0.90 | 0.50 | 0.25 | 0.50 | -3.00 | -4.00 |  |" in text
    assert "quick" not in text and "average" not in text
    record(tmp_path, "ppo_aib", 1, [0.4], task="InterceptFast-v0")
    report.main(report.Args(runs=tmp_path, output=tmp_path / "report"))
    text = (tmp_path / "report" / "report.md").read_text()
    assert "| ppo_aib | InterceptFast, RememberShapeAndColor3x2 | 0.50 | 0.25 |" in text, "seed 1 alone has both"
    assert iio.imread(tmp_path / "report" / "learning_curves.png").std() > 10


def test_six_seeds_have_a_bootstrap_interval() -> None:
    assert report.summarise([0.1, 0.2, 0.3, 0.4, 0.5]) == "0.30 (0.10, 0.20, 0.30, 0.40, 0.50)"
    text = report.summarise([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    assert text.startswith("0.35 ± 0.19 [")  # sample deviation 0.1871; the mean's standard error is near 0.070
    low, high = text.split("[")[1].rstrip("]").split(", ")
    assert 0.2 < float(low) < 0.25 and 0.45 < float(high) < 0.5


def test_aib_and_believer_are_compared_at_equal_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "rows_of", lambda table: [(TASK, "small")] if table == "agents" else [])
    rows = []
    for method, seed, values in (("AIB", 1, [0.1, 0.3, 0.5, 0.7, 1.0]), ("Believer", 1, [0.2, 0.2, 0.2, 0.2])):
        rows += [(method, seed, step, value) for step, value in enumerate(values, 1)]
    rows += [("AIB", 2, 1, 0.5), ("Believer", 2, 1, 0.6), ("AIB", 3, 1, 0.9)]  # seed 3 has no partner
    for seed in range(4, 8):
        rows += [("AIB", seed, 1, 0.5), ("Believer", seed, 1, 0.5)]
    evals = []
    for method, seed, step, value in rows:
        run = {"task": TASK, "method": method, "setting": "small", "seed": seed, "step": step}
        evals.append({**run, "success_once": value, "success_at_end": value / 2})
    tests = []
    found = [("AIB", 1, 5, 0.9), ("Believer", 1, 4, 0.1), ("AIB", 2, 1, 0.4), ("Believer", 2, 1, 0.3)]
    for method, seed, step, value in [*found, ("AIB", 4, 1, 0.5), ("Believer", 4, 1, 0.5)]:
        run = {"task": TASK, "method": method, "setting": "small", "seed": seed, "step": step}
        tests.append({**run, "success_once": value, "success_at_end": value / 2})
    table = report.pairs_table(pd.DataFrame(evals), pd.DataFrame(tests)).splitlines()
    # seed 1 at step 4: 0.3, 0.5, 0.7 against 0.2; without the end of the longer run, and without its test
    task = "| RememberShapeAndColor3x2 | small"
    assert table[2] == f"{task} | 1 | 4 | 0.50 | 0.20 | +0.30 | +0.15 |  |  |  |  |"
    assert table[3] == f"{task} | 2 | 1 | 0.50 | 0.60 | -0.10 | -0.05 | 0.40 | 0.30 | +0.10 | +0.05 |"
    means = ["+0.03 ± 0.14 [-0.05, +0.15], 6 pairs", "+0.02 ± 0.07 [-0.02, +0.07], 6 pairs"]
    tested = ["+0.05 (+0.10, +0.00), 2 pairs", "+0.03 (+0.05, +0.00), 2 pairs"]
    assert (
        table[8]
        == f"| mean, Remember tasks |  |  |  |  |  | {means[0]} | {means[1]} |  |  | {tested[0]} | {tested[1]} |"
    )
    assert table[9].startswith("| mean, Intercept tasks |") and len(table) == 10


def test_runs_are_added_to_the_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record(tmp_path, "ppo_aib_small", 3, [0.25, 0.5])
    (tmp_path / f"{TASK}__ppo_aib_small__3" / "evaluation.json").write_text(
        '{"global_step": 960, "success_once": 0.75}'
    )
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    for name in ("eval.csv", "test.csv"):
        (tmp_path / name).write_text(",".join(report.KEY + report.METRICS) + "\n")
    (tmp_path / "beliefs.csv").write_text(",".join([*report.KEY, "metric", "value"]) + "\n")
    head = "setting,aib_repr,aib_belief,ppo,steps_before_ppo,note\n"
    (tmp_path / "settings.csv").write_text(head)
    with pytest.raises(SystemExit):
        report.main(report.Args(runs=tmp_path, add="pink noise"))
    assert report.read("eval.csv").empty
    (tmp_path / "settings.csv").write_text(head + "pink noise,,,--noise-beta 1,,\n")
    report.main(report.Args(runs=tmp_path, add="pink noise"))
    report.main(report.Args(runs=tmp_path, add="pink noise"))  # a second time in place of the first
    rows = (tmp_path / "eval.csv").read_text().splitlines()[1:]
    assert rows == [
        f"{TASK},AIB,pink noise,3,{x},," for x in ("1000,0.2500,0.1250,3.5000", "2000,0.5000,0.2500,3.5000")
    ]
    assert (tmp_path / "test.csv").read_text().splitlines()[1:] == [f"{TASK},AIB,pink noise,3,960,0.7500,,,,"]


def test_pages_and_figures_are_those_of_the_data(tmp_path: Path) -> None:
    for folder in ("docs", "benchmark/results"):
        (tmp_path / folder).mkdir(parents=True)
    report.rebuild(tmp_path)
    for page in ("README.md", "docs/results.md"):
        assert (tmp_path / page).read_text() == (ROOT / page).read_text(), f"python benchmark/report.py changes {page}"
    for name in ("learning_curves.png", "beliefs.png"):
        made, kept = (iio.imread(root / "benchmark" / "results" / name) for root in (tmp_path, ROOT))
        assert np.array_equal(made, kept), f"python benchmark/report.py changes {name}"


def test_every_setting_of_the_results_is_explained() -> None:
    settings = report.read("settings.csv")
    files = ("eval.csv", "test.csv", "beliefs.csv", "nearest.csv")
    assert {*settings.setting} == {setting for name in files for setting in report.read(name).setting}
    for row in settings[settings.commit.isna()].fillna("").itertuples():  # the others: arguments of that commit
        for script in ("aib_repr", "aib_belief"):
            tyro.cli(SCRIPTS[script].Args, args=shlex.split(getattr(row, script)))
        tyro.cli(SCRIPTS["ppo_aib"].Args, args=shlex.split(row.ppo))


def test_every_result_is_in_a_table_or_quoted() -> None:
    def runs(name: str) -> set[tuple[str, str]]:
        return {(row.task, row.setting) for row in report.read(name).itertuples()}

    named, files = runs("tables.csv"), ("eval.csv", "test.csv", "beliefs.csv", "nearest.csv")
    assert all(runs(name) <= named for name in files)  # table "text": quoted in docs/results.md


def test_rows_of_the_results_are_unique() -> None:
    for name, key in (("eval.csv", report.KEY), ("test.csv", report.KEY), ("beliefs.csv", [*report.KEY, "metric"])):
        assert not report.read(name).duplicated(key).any()


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
