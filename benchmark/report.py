"""The tables and figures of README.md and docs/results.md from benchmark/results/*.csv, or a report on runs/.

Usage:   python benchmark/report.py                                  (README.md, docs/results.md and their figures)
         python benchmark/report.py --runs runs                      (learning curves and last values of your runs)
         python benchmark/report.py --runs runs --add small    (append your runs to eval.csv, test.csv, beliefs.csv)
Reads:   benchmark/results/: eval.csv, test.csv, beliefs.csv, nearest.csv, paper.csv, tables.csv (rows of tables);
         or runs/*/: args.json with eval.csv, evaluation.json (of --evaluate), diagnostics.json
Writes:  tables between <!-- name --> and <!-- end --> in the pages, PNG figures; or benchmark/report/
"""

import csv
import json
import math
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import matplotlib
import numpy as np
import scipy.stats
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.ticker import EngFormatter  # noqa: E402

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmark" / "results"
KEY = ["task", "method", "setting", "seed", "step"]
METRICS = ["success_once", "success_at_end", "return", "u_r2", "u_r2_at_end"]
METHODS = {"ppo_aib": "AIB", "ppo_believer": "Believer", "ppo_baseline": "PPO"}
ORACLES = {"true_state": "oracle state", "true_u": "oracle u", "true_target": "oracle target"}
HEADS = {"flow": "AIB", "mse": "AIB, MSE head", "none": "AIB, no head", None: "Believer"}  # action_head in args.json
COLOURS = {"AIB": "tab:red", "Believer": "tab:blue", "PPO": "tab:green"}
COLOURS |= {"AIB, MSE head": "tab:orange", "AIB, no head": "tab:purple"}
CHANCE = {  # one of so many objects is the right one
    "RememberColor3-v0": 1 / 3,
    "RememberColor5-v0": 1 / 5,
    "RememberColor9-v0": 1 / 9,
    "RememberShapeAndColor3x2-v0": 1 / 6,
}
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
    """append the runs to benchmark/results under this name of their setting, which settings.csv must have"""
    output: Path = Path("benchmark/report")
    """where the report on --runs goes"""


def fail(message: str) -> NoReturn:
    """Say on stderr what is wrong and what to do, and leave with exit code 2."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


# ---------------------------------------------------------------- data


def read(name: str) -> list[dict[str, str]]:
    """The rows of one of benchmark/results' CSV files."""
    with (RESULTS / name).open() as file:
        return list(csv.DictReader(file))


def rows_of(table: str) -> list[tuple[str, str]]:
    """Task and setting of each row of a table; README's has rows of tasks that were not run, without a setting."""
    return [(row["task"], row["setting"]) for row in read("tables.csv") if row["table"] == table]


def eval_rows(folder: Path, setting: str) -> tuple[list[dict], list[dict]]:
    """Rows as in eval.csv and test.csv of all runs in a folder; setting "" names each by its exp_name.

    The method follows from how exp_name begins; it is exp_name itself where that tells none. --quick runs are left out.
    """
    rows, test_rows = [], []
    for file in sorted(folder.glob("*__*__*/eval.csv")):
        args = json.loads((file.parent / "args.json").read_text())
        if args["quick"]:
            continue
        name = args["exp_name"]
        method = next((method for start, method in (METHODS | ORACLES).items() if name.startswith(start)), name)
        run = {"task": args["env_id"], "method": method, "seed": args["seed"], "setting": setting or name}
        for row in csv.DictReader(file.open()):
            rows.append({**run, "step": row["global_step"], **rounded(row)})
        test = file.with_name("evaluation.json")
        if test.exists():
            found = json.loads(test.read_text())
            test_rows.append({**run, "step": found["global_step"], **rounded(found)})
    return rows, test_rows


def rounded(row: dict) -> dict[str, str]:
    """The metrics of an evaluation."""
    return {name: f"{float(row[name]):.4f}" for name in METRICS if name in row}


def belief_rows(folder: Path, setting: str) -> list[dict]:
    """Rows as in beliefs.csv of all diagnostics.json in a folder, at every fifth time step, 4, 9 and the last."""
    rows = []
    for file in sorted(folder.glob("*__*__*/diagnostics.json")):
        args = json.loads((file.parent / "args.json").read_text())
        if args["quick"]:
            continue
        run = {"task": args["env_id"], "method": HEADS[args.get("action_head")], "seed": args["seed"]}
        run["setting"] = setting or args["exp_name"]
        for metric, values in json.loads(file.read_text()).items():
            if not isinstance(values, list):
                rows.append({**run, "step": "", "metric": metric, "value": f"{values:.3f}"})
                continue
            for step, value in enumerate(values):
                if step % 5 == 0 or step in (4, 9, len(values) - 1):
                    rows.append({**run, "step": step, "metric": metric, "value": f"{value:.3f}"})
    return rows


def append(name: str, columns: list[str], rows: list[dict]) -> None:
    """Add rows to one of benchmark/results' CSV files."""
    with (RESULTS / name).open("a", newline="") as file:
        csv.DictWriter(file, columns, restval="", lineterminator="\n").writerows(rows)


def by_seed(rows: list[dict], column: str, **chosen: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Steps and values of a column by seed, of the rows whose other columns are as chosen."""
    found = defaultdict(list)
    for row in rows:
        if all(row[name] == value for name, value in chosen.items()) and row.get(column):
            found[row["seed"]].append((float(row["step"] or 0), float(row[column])))
    return {seed: tuple(np.array(sorted(pairs)).T) for seed, pairs in sorted(found.items())}


def runs_of(table: str, methods: Iterable[str], rows: list[dict], column: str) -> Iterator[tuple[dict, list, dict]]:
    """What selects the runs of each row of a table and each method that has some; its cells; the column by seed."""
    for task, setting in rows_of(table):
        for method in methods:
            chosen = {"task": task, "method": method, "setting": setting}
            if curves := by_seed(rows, column, **chosen):
                yield chosen, [task.removesuffix("-v0"), method, setting], curves


def last_three(curves: dict[str, tuple[np.ndarray, np.ndarray]]) -> list[float]:
    """The paper's summary of each seed: the mean of the last three evaluations."""
    return [values[-3:].mean() for _, values in curves.values()]


def bootstrap_interval(values: list[float]) -> tuple[float, float]:
    """95 % bootstrap interval of the mean."""
    return scipy.stats.bootstrap((values,), np.mean, method="percentile", rng=0).confidence_interval


def summarise(values: list[float]) -> str:
    """Mean (each seed); from six on mean ± sample standard deviation [95 % bootstrap interval of the mean]."""
    if len(values) < 2:
        return "".join(f"{value:.2f}" for value in values)
    if len(values) < 6:
        return f"{np.mean(values):.2f} ({', '.join(f'{value:.2f}' for value in values)})"
    low, high = bootstrap_interval(values)
    return f"{np.mean(values):.2f} ± {np.std(values, ddof=1):.2f} [{low:.2f}, {high:.2f}]"


def mean_difference(values: list[float]) -> str:
    """Mean, from six on with its 95 % bootstrap interval, and how many."""
    if not values:
        return ""
    interval = ""
    if len(values) >= 6:
        low, high = bootstrap_interval(values)
        interval = f" [{low:+.2f}, {high:+.2f}]"
    return f"{np.mean(values):+.2f}{interval}, {len(values)} pairs"


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """A table."""
    lines = ["| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows]]
    return "\n".join(lines)


# ---------------------------------------------------------------- tables


def results_table(evals: list[dict]) -> str:
    """README's: per task success_once of the paper and here, mean of the last three evaluations."""
    paper = {(row["task"], row["method"]): row for row in read("paper.csv") if row["metric"] == "success_once"}
    rows = []
    for task, setting in rows_of("results"):
        row = [task.removesuffix("-v0"), f"{CHANCE[task]:.2f}" if task in CHANCE else ""]
        for method in METHODS.values():
            theirs = paper.get((task, method))
            row.append(f"{theirs['last']} ± {theirs['last_std']}" if theirs else "")
        for method in METHODS.values():
            row.append(summarise(last_three(by_seed(evals, "success_once", task=task, method=method, setting=setting))))
        rows.append(row)
    head = ["task", "chance", *[f"{method}, paper" for method in METHODS.values()]]
    head += [f"{method}, here" for method in METHODS.values()]
    return markdown(head, rows)


def agents_table(table: str, evals: list[dict], tests: list[dict]) -> str:
    """Agents with pictures: success_once and success_at_end; the last agents' on test episodes."""
    rows = []
    before = {row["setting"]: row["steps_before_ppo"] for row in read("settings.csv")}
    for chosen, run, curves in runs_of(table, METHODS.values(), evals, "success_once"):
        steps = min(curve[0][-1] for curve in curves.values())
        steps_before = 0 if chosen["method"] == "PPO" else int(before[chosen["setting"]])
        cells = [summarise(last_three(by_seed(evals, metric, **chosen))) for metric in METRICS[:2]]
        for metric in METRICS[:2]:
            tested = by_seed(tests, metric, **chosen)
            cells.append(summarise([values[-1] for _, values in tested.values()]))
            if 0 < len(tested) < len(curves):
                cells[-1] += f" (seed {', '.join(tested)})"
        rows.append([*run, ", ".join(curves), f"{steps_before:,}", f"{steps:,.0f}", *cells])
    head = ["task", "method", "setting", "seeds", "steps before", "PPO steps", *METRICS[:2], "test: once", "at end"]
    return markdown(head, rows)


def pairs_table(evals: list[dict], tests: list[dict]) -> str:
    """success_once of AIB and Believer of one task, setting and seed at equal steps, and mean differences."""
    rows, differences = [], ([], [])  # of evaluations, of test episodes
    for task, setting in rows_of("agents"):
        curves, tested = [], []
        for method in ("AIB", "Believer"):
            chosen = {"task": task, "setting": setting, "method": method}
            curves.append(by_seed(evals, "success_once", **chosen))
            tested.append(by_seed(tests, "success_once", **chosen))
        for seed in sorted(curves[0].keys() & curves[1].keys()):
            last = min(curve[seed][0][-1] for curve in curves)
            pairs = [[values[steps <= last][-3:].mean() for steps, values in (curve[seed] for curve in curves)]]
            if all(seed in agents and agents[seed][0][-1] == last for agents in tested):
                pairs.append([agents[seed][1][-1] for agents in tested])
            row = [task.removesuffix("-v0"), setting, seed, f"{last:,.0f}"]
            for found, (aib, believer) in zip(differences, pairs, strict=False):
                found.append((task, aib - believer))
                row += [f"{aib:.2f}", f"{believer:.2f}", f"{aib - believer:+.2f}"]
            rows.append(row + [""] * (10 - len(row)))
    for kind in ("Remember", "Intercept", ""):
        row = [f"mean, {kind or 'all'} tasks", "", "", ""]
        for found in differences:
            row += ["", "", mean_difference([difference for task, difference in found if task.startswith(kind)])]
        rows.append(row)
    head = ["task", "setting", "seed", "PPO steps", "evaluations: AIB", "Believer", "difference"]
    return markdown([*head, "test: AIB", "Believer", "difference"], rows)


def belief_cell(beliefs: list[dict], metric: str, **chosen: str) -> str:
    """A metric at the last time step, of each seed; the cue's chance once, as it is the same for all."""
    found = [values[-1] for _, values in by_seed(beliefs, "value", metric=metric, **chosen).values()]
    return summarise(found[:1] if metric == "cue_chance" else found)


def beliefs_table(beliefs: list[dict], table: str, methods: list[str], metrics: list[str]) -> str:
    """What beliefs know at the last step of held-out episodes; in one setting all methods have the same ones and u."""
    rows = []
    known = [row for row in beliefs if row["metric"] == "u_r2_prior"]
    for chosen, run, curves in runs_of(table, methods, known, "value"):
        rows.append([*run, ", ".join(curves), *[belief_cell(beliefs, metric, **chosen) for metric in metrics]])
    return markdown(["task", "method", "setting", "seeds", *[PROBES[metric] for metric in metrics]], rows)


def nearest_table(tests: list[dict]) -> str:
    """benchmark/nearest.py's numbers beside the successes on the same 256 test episodes."""
    rows = []
    for row in read("nearest.csv"):
        run = [row["task"].removesuffix("-v0"), row["method"], row["setting"], row["seed"], f"{int(row['step']):,}"]
        chosen = {name: row[name] for name in KEY}
        cells = [summarise([values[-1] for _, values in by_seed(tests, x, **chosen).values()]) for x in METRICS[:2]]
        rows.append([*run, f"{CHANCE[row['task']]:.2f}", f"{float(row['nearest_is_right']):.2f}", *cells])
    head = ["task", "method", "setting", "seed", "PPO steps", "chance", "nearest at the end is right", *METRICS[:2]]
    return markdown(head, rows)


def swapped_table(tests: list[dict]) -> str:
    """success_once on test episodes of agents that see their own particles, or those of another episode."""
    rows = []
    for chosen, run, own in runs_of("swapped", METHODS.values(), tests, "success_once"):
        chosen["setting"] += ", another episode's particles"
        for seed, (_, swapped) in by_seed(tests, "success_once", **chosen).items():
            rows.append([*run, seed, f"{own[seed][1][-1]:.2f}", f"{swapped[-1]:.2f}"])
    return markdown(["task", "method", "setting", "seed", "own particles", "another episode's"], rows)


def oracle_table(evals: list[dict]) -> str:
    """PPO without pictures on the privileged state, on u or on the target position: success_once of each seed.

    The last evaluation until each step.
    """
    rows = []
    for _, (task, method, setting), curves in runs_of("oracle", ORACLES.values(), evals, "success_once"):
        rows.append([task, method.removeprefix("oracle "), setting, ", ".join(curves)])
        for step in ORACLE_STEPS:
            reached = [values[steps <= step][-1] for steps, values in curves.values() if steps[-1] > 0.95 * step]
            rows[-1].append(", ".join(f"{value:.2f}" for value in reached))
    return markdown(["task", "the policy sees", "setting", "seeds", *[f"{step:,}" for step in ORACLE_STEPS]], rows)


def shift_table(evals: list[dict], tests: list[dict], beliefs: list[dict]) -> str:
    """R² of u at the last step: held-out episodes; the agent's in its first and last evaluation; test episodes."""
    rows = []
    for chosen, run, curves in runs_of("agents", METHODS.values(), evals, "u_r2_at_end"):
        success = by_seed(evals, "success_once", **chosen)
        for seed, (steps, known) in curves.items():
            held_out = belief_cell(beliefs, "u_r2_prior", seed=seed, **chosen)
            tested = by_seed(tests, "u_r2_at_end", seed=seed, **chosen)
            test = f"{tested[seed][1][-1]:.2f}" if tested else ""
            cells = [held_out, f"{known[0]:.2f}", f"{known[-1]:.2f}", test, f"{success[seed][1][-1]:.2f}"]
            rows.append([*run, seed, f"{steps[-1]:,.0f}", *cells])
    head = ["task", "method", "setting", "seed", "PPO steps", "R² of u, held-out", "agent's, first", "last", "test"]
    return markdown([*head, "success_once, last"], rows)


# ---------------------------------------------------------------- figures


def draw(axes: plt.Axes, curves: dict[str, tuple[np.ndarray, np.ndarray]], label: str, colour: str | None) -> None:
    """Mean over seeds at the steps all of them have, and each seed as a thin line."""
    if not curves:
        return
    steps = sorted(set.intersection(*(set(steps) for steps, _ in curves.values())))
    values = np.stack([values[np.isin(seed_steps, steps)] for seed_steps, values in curves.values()])
    (line,) = axes.plot(steps, values.mean(0), color=colour, label=label)
    if len(curves) > 1:
        axes.plot(steps, values.T, color=line.get_color(), linewidth=0.8, alpha=0.4)


def save_figure(figure: plt.Figure, axes: np.ndarray, path: Path) -> None:
    """One legend below all panels; the same bytes each time."""
    entries = {}
    for ax in np.ravel(axes):
        ax.grid(alpha=0.3)
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries[label] = handle
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=len(entries), frameon=False)
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)


def learning_curves(evals: list[dict], path: Path) -> None:
    """success_once of the three methods on each task of README's table, in its first row that has runs, and chance."""
    panels = {}
    for task, setting in rows_of("results"):
        if by_seed(evals, "success_once", task=task, setting=setting):
            panels.setdefault(task, setting)
    figure, axes = plt.subplots(2, math.ceil(len(panels) / 2), figsize=(12, 6), layout="constrained", sharey=True)
    for ax, (task, setting) in zip(axes.flat, panels.items(), strict=False):
        seeds = []
        for method in METHODS.values():
            curves = by_seed(evals, "success_once", task=task, method=method, setting=setting)
            draw(ax, curves, method, COLOURS[method])
            seeds.append(f"{len(curves)} {method}")
        if task in CHANCE:
            ax.axhline(CHANCE[task], color="grey", linestyle=":", label="chance")
        ax.set_title(f"{task.removesuffix('-v0')}\nseeds: {', '.join(seeds)}", fontsize=9)
        ax.set(xlabel="PPO steps", ylim=(-0.03, 1.03))  # curves at 0 beside the axis
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))  # 100k
    for ax in axes[:, 0]:
        ax.set_ylabel("success_once")
    save_figure(figure, axes, path)


def belief_figure(beliefs: list[dict], path: Path) -> None:
    """Cue and R² of u from the mean particle by time step: action heads and Believer at the same setting."""
    columns = [("RememberColor3-v0", "128 px, 640 episodes, 600 updates, kl_coef 0.01, no gradient clipping")]
    columns += [("RememberShapeAndColor3x2-v0", HEAD_SETTING), ("InterceptFast-v0", HEAD_SETTING)]
    figure, axes = plt.subplots(2, 3, figsize=(12, 5.5), layout="constrained", sharex="col")
    for (task, setting), column in zip(columns, axes.T, strict=True):
        chance = next(iter(by_seed(beliefs, "value", task=task, setting=setting, metric="cue_chance").values()))[1][0]
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


def replace_tables(page: str, tables: dict[str, str]) -> str:
    """The page with every table between <!-- name --> and <!-- end --> made anew."""
    for name, table in tables.items():
        page = re.sub(rf"(<!-- {name} -->\n).*?(<!-- end -->)", rf"\g<1>{table}\n\g<2>", page, flags=re.DOTALL)
    return page


def rebuild(output: Path) -> None:
    """README.md, docs/results.md and their figures, below output."""
    evals, tests, beliefs = read("eval.csv"), read("test.csv"), read("beliefs.csv")
    tables = {name: agents_table(name, evals, tests) for name in ("agents", "choices")}
    tables |= {"results": results_table(evals), "pairs": pairs_table(evals, tests)}
    tables |= {"oracle": oracle_table(evals), "shift": shift_table(evals, tests, beliefs)}
    tables |= {"nearest": nearest_table(tests), "swapped": swapped_table(tests)}
    tables["beliefs"] = beliefs_table(beliefs, "beliefs", ["AIB"], list(PROBES)[:5])
    tables["heads"] = beliefs_table(beliefs, "heads", list(HEADS.values()), list(PROBES)[3:6])
    for page in ("README.md", "docs/results.md"):
        (output / page).write_text(replace_tables((ROOT / page).read_text(), tables))
    learning_curves(evals, output / "benchmark" / "results" / "learning_curves.png")
    belief_figure(beliefs, output / "benchmark" / "results" / "beliefs.png")


def own_beliefs(beliefs: list[dict], task: str) -> str:
    """The beliefs of one task by setting (exp_name): metrics at the last time step of held-out random episodes."""
    rows = []
    for setting, method in sorted({(row["setting"], row["method"]) for row in beliefs if row["task"] == task}):
        chosen = {"task": task, "method": method, "setting": setting}
        rows.append([setting, *[belief_cell(beliefs, metric, **chosen) for metric in PROBES]])
    return markdown([task, *PROBES.values()], rows)


def own_runs(evals: list[dict], task: str) -> str:
    """The runs of one task by setting (exp_name), below the paper's: last values and maxima."""
    rows = []
    for row in read("paper.csv"):
        if row["task"] == task:
            cells = [f"{row['last']} ± {row['last_std']}", f"{row['max']} ± {row['max_std']}"]
            rows.append([row["metric"], f"{row['method']}, the paper's", *cells])
    for setting in sorted({row["setting"] for row in evals if row["task"] == task}):
        for metric in METRICS[:2]:
            curves = by_seed(evals, metric, task=task, setting=setting)
            steps = min(int(steps[-1]) for steps, _ in curves.values())
            maxima = [values.max() for _, values in curves.values()]
            rows.append([metric, f"{setting}, {steps:,} steps", summarise(last_three(curves)), summarise(maxima)])
    return markdown([task, "run", "mean of the last three", "maximum"], sorted(rows))


def report_runs(args: Args) -> None:
    """Tables and learning curves of a folder of runs, a row and a curve per exp_name."""
    (evals, _), beliefs = eval_rows(args.runs, ""), belief_rows(args.runs, "")
    tasks = sorted({row["task"] for row in evals})
    if not tasks:
        fail(f"no eval.csv of a run without --quick below {args.runs}; name the folder of run directories with --runs")
    args.output.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(1, len(tasks), figsize=(5 * len(tasks), 4), layout="constrained", squeeze=False)
    for ax, task in zip(axes[0], tasks, strict=True):
        for setting in sorted({row["setting"] for row in evals if row["task"] == task}):
            draw(ax, by_seed(evals, "success_once", task=task, setting=setting), setting, None)
        if task in CHANCE:
            ax.axhline(CHANCE[task], color="grey", linestyle=":", label="chance")
        ax.set(title=task, xlabel="environment steps", ylabel="success_once", ylim=(0, 1.02))
    save_figure(figure, axes, args.output / "learning_curves.png")
    parts = ["# Report", *[own_runs(evals, task) for task in tasks], "![success_once](learning_curves.png)"]
    parts += [own_beliefs(beliefs, task) for task in sorted({row["task"] for row in beliefs})]
    (args.output / "report.md").write_text("\n\n".join(parts) + "\n")
    print(f"{args.output / 'report.md'}: {', '.join(tasks)}")


def main(args: Args) -> None:
    """Rebuild the project's pages, report on runs, or add them to the results."""
    if args.runs is None:
        rebuild(ROOT)
    elif args.add:
        if args.add not in [row["setting"] for row in read("settings.csv")]:
            fail(f"benchmark/results/settings.csv has no --add {args.add}; describe that setting there first")
        for name, rows in zip(("eval.csv", "test.csv"), eval_rows(args.runs, args.add), strict=True):
            append(name, KEY + METRICS, rows)
        append("beliefs.csv", [*KEY, "metric", "value"], belief_rows(args.runs, args.add))
    else:
        report_runs(args)


if __name__ == "__main__":
    main(tyro.cli(Args))
