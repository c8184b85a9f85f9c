"""The tables and figures of README.md and docs/results.md from benchmark/results/*.csv, or a report on runs/.

Usage:   python benchmark/report.py                                  (README.md, docs/results.md and their figures)
         python benchmark/report.py --runs runs                      (learning curves and last values of your runs)
         python benchmark/report.py --runs runs --add small    (add your runs to eval.csv, test.csv, beliefs.csv)
Reads:   benchmark/results/: eval.csv, test.csv, beliefs.csv, nearest.csv, paper.csv, tables.csv (rows of tables);
         or runs/*/: args.json with eval.csv, evaluation.json (of --evaluate), diagnostics.json
Writes:  tables between <!-- name --> and <!-- end --> in the pages, PNG figures; or benchmark/report/
"""

import json
import math
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import matplotlib
import numpy as np
import pandas as pd
import scipy.stats
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.ticker import EngFormatter  # noqa: E402

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmark" / "results"
KEY = ["task", "method", "setting", "seed", "step"]
METRICS = ["success_once", "success_at_end", "return", "u_r2", "u_r2_at_end"]
METHODS = {"ppo_aib": "AIB", "ppo_believer": "Believer", "ppo_baseline": "PPO"}  # by how exp_name begins
ORACLES = {"true_state": "oracle state", "true_u": "oracle u", "true_target": "oracle target"}
HEADS = {"flow": "AIB", "mse": "AIB, MSE head", "none": "AIB, no head", None: "Believer"}  # action_head in args.json
COLOURS = {"AIB": "tab:red", "Believer": "tab:blue", "PPO": "tab:green"}
COLOURS |= {"AIB, MSE head": "tab:orange", "AIB, no head": "tab:purple"}
OBJECTS = {"RememberColor3": 3, "RememberColor5": 5, "RememberColor9": 9, "RememberShapeAndColor3x2": 6}
CHANCE = {f"{task}-v0": 1 / count for task, count in OBJECTS.items()}  # one of the objects is the right one
HEAD_SETTING = "128 px, 2000 episodes, 700 updates"
PROBES = {"cue_chance": "chance of the cue", "cue_from_u": "cue from u", "cue_from_h": "cue from h"}
PROBES |= {"cue_from_particle": "cue from particles", "u_r2_prior": "R² of u", "action_readout": "R² of a_t"}
PROBES |= {"nll_prior": "−log p(u), prior", "nll_posterior": "posterior", "flow_gain": "flow gain"}
ORACLE_STEPS = (28800, 57600, 86400, 115200, 144000, 240000, 480000)


@dataclass
class Args:
    runs: Path | None = None
    """report on this folder of run directories; none: rebuild README.md and docs/results.md"""
    add: str = ""
    """add the runs to benchmark/results under this name of their setting, which settings.csv must have"""
    output: Path = Path("benchmark/report")
    """where the report on --runs goes"""


def fail(message: str) -> NoReturn:
    """Say on stderr what is wrong and what to do, and leave with exit code 2."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


# ---------------------------------------------------------------- data


def read(name: str) -> pd.DataFrame:
    """One of benchmark/results' CSV files."""
    return pd.read_csv(RESULTS / name)


def rows_of(table: str) -> list[tuple[str, str]]:
    """Task and setting of each row of a table."""
    return [(row.task, row.setting) for row in read("tables.csv").itertuples() if row.table == table]


def collect(folder: Path, setting: str = "") -> dict[str, pd.DataFrame]:
    """Rows as in eval.csv, test.csv and beliefs.csv of all runs in a folder but --quick ones.

    Without a setting each has its exp_name for one. The method follows from how exp_name begins, else it is exp_name.
    Beliefs are shown at every fifth time step, at 4, 9 and the last.
    """
    found = {"eval.csv": [], "test.csv": [], "beliefs.csv": []}
    for file in sorted(folder.glob("*__*__*/args.json")):
        args = json.loads(file.read_text())
        if args["quick"]:
            continue
        name = args["exp_name"]
        run = {"task": args["env_id"], "setting": setting or name, "seed": args["seed"]}
        method = next((method for start, method in (METHODS | ORACLES).items() if name.startswith(start)), name)
        if (evals := file.with_name("eval.csv")).exists():
            found["eval.csv"] += pd.read_csv(evals).assign(method=method, **run).to_dict("records")
        if (test := file.with_name("evaluation.json")).exists():
            found["test.csv"].append({"method": method, **run, **json.loads(test.read_text())})
        if (diagnostics := file.with_name("diagnostics.json")).exists():
            run["method"] = HEADS[args.get("action_head")]
            for metric, values in json.loads(diagnostics.read_text()).items():
                steps = {None: values}
                if isinstance(values, list):
                    shown = sorted({*range(0, len(values), 5), 4, 9, len(values) - 1})
                    steps = {step: values[step] for step in shown if step < len(values)}
                for step, value in steps.items():
                    found["beliefs.csv"].append({**run, "global_step": step, "metric": metric, "value": value})
    tables = {}
    for name, rows in found.items():
        columns = ["metric", "value"] if name == "beliefs.csv" else METRICS
        rows = pd.DataFrame(rows).rename(columns={"global_step": "step"})
        tables[name] = rows.reindex(columns=KEY + columns).astype({"seed": "Int64", "step": "Int64"})
    return tables


def select(rows: pd.DataFrame, **chosen: object) -> pd.DataFrame:
    """The rows whose columns are as chosen."""
    for name, value in chosen.items():
        rows = rows[rows[name] == value]
    return rows


def by_seed(rows: pd.DataFrame, column: str, **chosen: object) -> pd.DataFrame:
    """A column of the rows that are as chosen: a row per step, a column per seed."""
    curves = select(rows, **chosen).fillna({"step": 0}).pivot(index="step", columns="seed", values=column)
    return curves.dropna(how="all").dropna(how="all", axis="columns")


def last(curves: pd.DataFrame, count: int = 1) -> pd.Series:
    """Of each seed: the last value, or the mean of the last three, the paper's summary."""
    return pd.Series({seed: curve.dropna()[-count:].mean() for seed, curve in curves.items()}, dtype=float)


def runs_of(
    settings: list[tuple[str, str]], methods: Iterable[str], rows: pd.DataFrame, column: str
) -> Iterator[tuple]:
    """What selects the runs of each task, setting and method that has some; its cells; the column by seed."""
    for task, setting in settings:
        for method in methods:
            chosen = {"task": task, "method": method, "setting": setting}
            curves = by_seed(rows, column, **chosen)
            if not curves.empty:
                yield chosen, chosen | {"task": task.removesuffix("-v0"), "seeds": ", ".join(map(str, curves))}, curves


def summarise(values: pd.Series, sign: str = "") -> str:
    """Mean (each seed); from six on mean ± sample standard deviation [95 % bootstrap interval of the mean]."""
    if len(values) == 0:
        return ""
    mean = f"{np.mean(values):{sign}z.2f}"
    if len(values) == 1:
        return mean
    if len(values) < 6:
        return f"{mean} ({', '.join(f'{value:{sign}z.2f}' for value in values)})"
    low, high = scipy.stats.bootstrap((values,), np.mean, method="percentile", rng=0).confidence_interval
    return f"{mean} ± {np.std(values, ddof=1):.2f} [{low:{sign}.2f}, {high:{sign}.2f}]"


def markdown(rows: list[dict]) -> str:
    """A table, empty where a row has no value."""
    table = pd.DataFrame(rows, dtype=object).fillna("")
    cells = [table.columns, ["---"] * table.shape[1], *table.to_numpy()]
    return "\n".join(f"| {' | '.join(map(str, row))} |" for row in cells)


# ---------------------------------------------------------------- tables


def results_table(evals: pd.DataFrame) -> str:
    """README's: per task success_once of the paper and here, mean of the last three evaluations."""
    paper = {(row.task, row.method): row for row in select(read("paper.csv"), metric="success_once").itertuples()}
    rows = []
    for task, setting in rows_of("results"):
        row = {"task": task.removesuffix("-v0"), "chance": f"{CHANCE[task]:.2f}" if task in CHANCE else ""}
        for method in METHODS.values():
            theirs = paper.get((task, method))
            row[f"{method}, paper"] = f"{theirs.last:.2f} ± {theirs.last_std:.2f}" if theirs else ""
        for method in METHODS.values():
            curves = by_seed(evals, "success_once", task=task, method=method, setting=setting)
            row[f"{method}, here"] = summarise(last(curves, 3))
        rows.append(row)
    return markdown(rows)


def agents_table(table: str, evals: pd.DataFrame, tests: pd.DataFrame) -> str:
    """Agents with pictures: success_once and success_at_end; the last agents' on test episodes."""
    before = read("settings.csv").set_index("setting").steps_before_ppo
    rows = []
    for chosen, row, curves in runs_of(rows_of(table), METHODS.values(), evals, "success_once"):
        row["steps before"] = f"{0 if chosen['method'] == 'PPO' else before[chosen['setting']]:,.0f}"
        row["PPO steps"] = f"{min(curve.last_valid_index() for _, curve in curves.items()):,}"
        for metric in METRICS[:2]:
            row[metric] = summarise(last(by_seed(evals, metric, **chosen), 3))
        for metric in METRICS[:2]:
            tested = last(by_seed(tests, metric, **chosen))
            some = 0 < len(tested) < curves.shape[1]
            seeds = f" (seed {', '.join(map(str, tested.index))})" if some else ""
            row[f"test: {metric}"] = summarise(tested) + seeds
        rows.append(row)
    return markdown(rows)


def pairs_table(evals: pd.DataFrame, tests: pd.DataFrame) -> str:
    """success_once of AIB and Believer of one task, setting and seed at equal steps; differences, at the end too."""
    rows, differences = [], []
    for task, setting in rows_of("agents"):
        for seed, run in select(evals, task=task, setting=setting).groupby("seed"):
            steps = run.groupby("method").step.max().reindex(["AIB", "Believer"]).min(skipna=False)
            if math.isnan(steps):
                continue
            row = {"task": task.removesuffix("-v0"), "setting": setting, "seed": seed, "PPO steps": f"{steps:,.0f}"}
            found = {
                "": run[run.step <= steps],
                "test: ": select(tests, task=task, setting=setting, seed=seed, step=steps),
            }
            for prefix, values in found.items():
                for metric, column in (("success_once", "difference"), ("success_at_end", "at end")):
                    pair = last(values.pivot(index="step", columns="method", values=metric), 3)
                    if not {"AIB", "Believer"} <= {*pair.index}:
                        continue
                    if metric == "success_once":
                        row |= {f"{prefix}{method}": f"{pair[method]:.2f}" for method in ("AIB", "Believer")}
                    difference = pair["AIB"] - pair["Believer"]
                    row[prefix + column] = f"{difference:+.2f}"
                    differences.append({"task": task, "column": prefix + column, "value": difference})
            rows.append(row)
    differences = pd.DataFrame(differences)
    for kind in ("Remember", "Intercept"):
        row = {"task": f"mean, {kind} tasks"}
        for column, found in differences[differences.task.str.startswith(kind)].groupby("column"):
            row[column] = f"{summarise(found.value, '+')}, {len(found)} pairs"
        rows.append(row)
    return markdown(rows)


def belief_cell(beliefs: pd.DataFrame, metric: str, **chosen: object) -> str:
    """A metric at the last time step, of each seed; the cue's chance once, as it is the same for all."""
    values = last(by_seed(beliefs, "value", metric=metric, **chosen))
    return summarise(values[:1] if metric == "cue_chance" else values)


def beliefs_table(beliefs: pd.DataFrame, settings: list[tuple[str, str]], metrics: Iterable[str] = PROBES) -> str:
    """What beliefs know at the last step of held-out episodes; in one setting all methods have the same ones and u."""
    rows = []
    for chosen, row, _ in runs_of(settings, HEADS.values(), select(beliefs, metric="u_r2_prior"), "value"):
        found = select(beliefs, **chosen)
        rows.append(row | {PROBES[metric]: belief_cell(found, metric) for metric in metrics})
    return markdown(rows)


def tested_table(tests: pd.DataFrame) -> str:
    """On the 256 test episodes: success, where the hand ends, and success with another episode's particles."""
    nearest = read("nearest.csv")
    rows = []
    for chosen, row, curves in runs_of(rows_of("tested"), METHODS.values(), tests, "success_once"):
        for seed in curves:
            run = chosen | {"seed": seed}
            cells = {metric: summarise(last(by_seed(tests, metric, **run))) for metric in METRICS[:2]}
            cells["nearest is right"] = summarise(select(nearest, **run).nearest_is_right)
            run["setting"] += ", another episode's particles"
            cells["another episode's particles"] = summarise(select(tests, **run).success_once)
            if cells["nearest is right"] or cells["another episode's particles"]:
                rows.append(row | {"seeds": seed} | cells)
    return markdown(rows)


def oracle_table(evals: pd.DataFrame) -> str:
    """PPO without pictures on the privileged state, on u or on the target position: success_once of each seed.

    The last evaluation until each step.
    """
    rows = []
    for _, row, curves in runs_of(rows_of("oracle"), ORACLES.values(), evals, "success_once"):
        for step in ORACLE_STEPS:
            reached = [
                curve.loc[:step].iloc[-1] for _, curve in curves.items() if curve.last_valid_index() > 0.95 * step
            ]
            row[f"{step:,}"] = ", ".join(f"{value:.2f}" for value in reached)
        rows.append(row)
    return markdown(rows)


def shift_table(evals: pd.DataFrame, tests: pd.DataFrame, beliefs: pd.DataFrame) -> str:
    """R² of u at the last step: held-out episodes; the agent's in its first and last evaluation; test episodes."""
    rows = []
    for chosen, row, curves in runs_of(rows_of("agents"), METHODS.values(), evals, "u_r2_at_end"):
        success = last(by_seed(evals, "success_once", **chosen))
        for seed, curve in curves.items():
            known = curve.dropna()
            cells = {"seeds": seed, "PPO steps": f"{known.index[-1]:,}"}
            cells["R² of u, held-out"] = belief_cell(beliefs, "u_r2_prior", seed=seed, **chosen)
            cells |= {"agent's, first": f"{known.iloc[0]:.2f}", "last": f"{known.iloc[-1]:.2f}"}
            cells["test"] = summarise(last(by_seed(tests, "u_r2_at_end", seed=seed, **chosen)))
            rows.append(row | cells | {"success_once, last": f"{success[seed]:.2f}"})
    return markdown(rows)


# ---------------------------------------------------------------- figures


def draw(axes: plt.Axes, curves: pd.DataFrame, label: str, colour: str) -> None:
    """Mean over seeds at the steps all of them have, and each seed as a thin line."""
    if curves.empty:
        return
    common = curves.dropna()
    axes.plot(common.index, common.mean(axis="columns"), color=colour, label=label)
    if curves.shape[1] > 1:
        for _, curve in curves.items():
            curve = curve.dropna()
            axes.plot(curve.index, curve, color=colour, linewidth=0.8, alpha=0.4)


def save_figure(figure: plt.Figure, axes: np.ndarray, path: Path) -> None:
    """One legend below all panels; the same bytes each time."""
    entries = {}
    for ax in axes.flat:
        ax.grid(alpha=0.3)
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries[label] = handle
    columns = max(1, int(10 * figure.get_figwidth()) // max(map(len, entries)))  # as many as fit below
    columns = min(columns, len(entries))
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, frameon=False)
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)


def learning_curves(panels: list[tuple], path: Path, columns: int) -> None:
    """A metric and chance, one panel for each of: task, title, metric, curves with their labels and colours."""
    rows = math.ceil(len(panels) / columns)
    size = (4 * columns, 3 * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", sharey=True, squeeze=False)
    for ax, (task, title, metric, curves) in zip(axes.flat, panels, strict=False):
        for curve, label, colour in curves:
            draw(ax, curve, label, colour)
        if task in CHANCE:
            ax.axhline(CHANCE[task], color="grey", linestyle=":", label="chance")
        ax.set_title(title, fontsize=9)
        ax.set(xlabel="PPO steps", ylabel=metric, ylim=(-0.03, 1.03))  # curves at 0 beside the axis
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))  # 100k
    save_figure(figure, axes, path)


def belief_figure(beliefs: pd.DataFrame, path: Path) -> None:
    """Cue and R² of u from the mean particle by time step: action heads and Believer at the same setting."""
    columns = [("RememberColor3-v0", "128 px, 640 episodes, 600 updates, kl_coef 0.01, no gradient clipping")]
    columns += [("RememberShapeAndColor3x2-v0", HEAD_SETTING), ("InterceptFast-v0", HEAD_SETTING)]
    figure, axes = plt.subplots(2, 3, figsize=(12, 5.5), layout="constrained", sharex="col")
    for (task, setting), column in zip(columns, axes.T, strict=True):
        chance = select(beliefs, task=task, setting=setting, metric="cue_chance").value.iloc[0]
        metrics = {"cue_from_particle": "accuracy of the cue" if chance else "R² of the cue", "u_r2_prior": "R² of u"}
        for ax, (metric, label) in zip(column, metrics.items(), strict=True):
            for method in HEADS.values():
                curves = by_seed(beliefs, "value", task=task, method=method, setting=setting, metric=metric)
                draw(ax, curves, method, COLOURS[method])
            ax.set(ylabel=label, ylim=(-0.3, 1.05))
        column[0].axhline(chance, color="grey", linestyle=":", label="chance")
        column[0].set_title(task.removesuffix("-v0"))
        column[1].set_xlabel("time step")
    save_figure(figure, axes, path)


# ---------------------------------------------------------------- pages


def rebuild(output: Path) -> None:
    """README.md, docs/results.md and their figures, below output."""
    evals, tests, beliefs = read("eval.csv"), read("test.csv"), read("beliefs.csv")
    tables = {name: agents_table(name, evals, tests) for name in ("agents", "choices")}
    tables |= {"results": results_table(evals), "pairs": pairs_table(evals, tests)}
    tables |= {"oracle": oracle_table(evals), "shift": shift_table(evals, tests, beliefs)}
    tables["tested"] = tested_table(tests)
    tables["beliefs"] = beliefs_table(select(beliefs, method="AIB"), rows_of("beliefs"), [*PROBES][:5] + [*PROBES][6:8])
    tables["heads"] = beliefs_table(beliefs, rows_of("heads"), [*PROBES][3:6])
    for page in ("README.md", "docs/results.md"):
        text = (ROOT / page).read_text()
        for name, table in tables.items():
            text = re.sub(rf"(<!-- {name} -->\n).*?(<!-- end -->)", rf"\g<1>{table}\n\g<2>", text, flags=re.DOTALL)
        (output / page).write_text(text)
    panels = []
    for task, setting in rows_of("results"):
        curves = []
        for method in METHODS.values():
            found = by_seed(evals, "success_once", task=task, method=method, setting=setting)
            curves.append((found, method, COLOURS[method]))
        seeds = ", ".join(f"{found.shape[1]} {method}" for found, method, _ in curves)
        panels.append((task, f"{task.removesuffix('-v0')}\nseeds: {seeds}", "success_once", curves))
    learning_curves(panels, output / "benchmark" / "results" / "learning_curves.png", columns=3)
    belief_figure(beliefs, output / "benchmark" / "results" / "beliefs.png")


def plus_minus(values: pd.Series) -> str:
    """Mean ± sample standard deviation over seeds, of which one has none."""
    return f"{values.mean():.2f}" + (f" ± {values.std(ddof=1):.2f}" if len(values) > 1 else "")


def own_runs(evals: pd.DataFrame, task: str) -> str:
    """The runs of one task by setting (exp_name), below the paper's: last values and maxima."""
    rows = []
    for row in select(read("paper.csv"), task=task).itertuples():
        values = (f"{row.last:.2f} ± {row.last_std:.2f}", f"{row.max:.2f} ± {row.max_std:.2f}")
        rows.append((row.metric, f"{row.method}, the paper's", *values))
    for setting, found in select(evals, task=task).groupby("setting"):
        steps = found.groupby("seed").step.max().min()
        for metric in METRICS[:2]:
            curves = by_seed(found, metric)
            rows.append((metric, f"{setting}, {steps:,} steps", plus_minus(last(curves, 3)), plus_minus(curves.max())))
    head = (task, "run", "mean of the last three", "maximum")
    return markdown([dict(zip(head, row, strict=True)) for row in sorted(rows)])


def average(evals: pd.DataFrame) -> str:
    """Each setting's (exp_name's) mean over its tasks, as the paper's AVG row: of each seed that has them all."""
    rows = []
    for setting, found in evals.groupby("setting"):
        row = {"average": setting, "tasks": ", ".join(task.removesuffix("-v0") for task in sorted({*found.task}))}
        for metric in METRICS[:2]:
            by_task = [last(by_seed(runs, metric), 3) for _, runs in found.groupby("task")]
            row[metric] = plus_minus(pd.concat(by_task, axis=1).dropna().mean(axis=1))
        rows.append(row)
    return markdown(rows)


def report_runs(args: Args) -> None:
    """Tables and learning curves of a folder of runs, a row and a curve per exp_name."""
    evals, _, beliefs = collect(args.runs).values()
    if evals.empty:
        fail(f"no eval.csv of a run without --quick below {args.runs}; name the folder of run directories with --runs")
    args.output.mkdir(parents=True, exist_ok=True)
    panels, parts = [], ["# Report"]
    colours = {setting: f"C{i % 10}" for i, setting in enumerate(sorted(evals.setting.unique()))}
    tasks = sorted({*evals.task})
    for metric in METRICS[:2]:
        for task in tasks:
            curves = [
                (by_seed(runs, metric), setting, colours[setting])
                for setting, runs in select(evals, task=task).groupby("setting")
            ]
            panels.append((task, task, metric, curves))
    learning_curves(panels, args.output / "learning_curves.png", columns=len(tasks))
    parts += [own_runs(evals, task) for task in tasks]
    if len(tasks) > 1:
        parts.append(average(evals))
    parts.append("![success_once and success_at_end](learning_curves.png)")
    if not beliefs.empty:
        parts.append(beliefs_table(beliefs, sorted({*zip(beliefs.task, beliefs.setting, strict=True)})))
    (args.output / "report.md").write_text("\n\n".join(parts) + "\n")
    print(f"{args.output / 'report.md'}: {', '.join(tasks)}")


def main(args: Args) -> None:
    """Rebuild the project's pages, report on runs, or add them to the results."""
    if args.runs is None:
        rebuild(ROOT)
    elif args.add:
        if args.add not in [*read("settings.csv").setting]:
            fail(f"benchmark/results/settings.csv has no --add {args.add}; describe that setting there first")
        for name, rows in collect(args.runs, args.add).items():
            key, digits = (KEY + ["metric"], 3) if name == "beliefs.csv" else (KEY, 4)
            rows = pd.concat([read(name).astype({"step": "Int64"}), rows]).drop_duplicates(key, keep="last")
            rows.to_csv(RESULTS / name, index=False, float_format=f"%.{digits}f")
    else:
        report_runs(args)


if __name__ == "__main__":
    main(tyro.cli(Args))
