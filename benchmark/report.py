"""The tables and figures of README.md and docs/results.md from benchmark/results/*.csv, or a report on runs/.

Usage:   python benchmark/report.py                       (README.md, docs/results.md and their figures)
         python benchmark/report.py --runs runs           (learning curves and last values of your runs)
         python benchmark/report.py --runs runs --add     (add your runs to eval.csv, test.csv and beliefs.csv)
Reads:   benchmark/results/: eval.csv, test.csv, beliefs.csv, paper.csv; or runs/*/: args.json with eval.csv, and what
         --evaluate, diagnose_agent.py and belief.py wrote
Writes:  tables between <!-- name --> and <!-- end --> in the pages, PNG figures; or benchmark/report/
"""

import json
import math
import re
import subprocess
import sys
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
RUN = ["task", "exp_name", "seed", "commit"]  # what tells one run from another
METRICS = ["success_once", "success_at_end"]
COLUMNS = {  # of each file, after RUN and step
    "eval.csv": [*METRICS, "return", "steps_before"],
    "test.csv": [*METRICS, "return", "nearest_is_right", "swapped_success_once"],
    "beliefs.csv": ["metric", "value"],
}
TASKS = ["RememberShapeAndColor3x2-v0", "RememberColor9-v0", "InterceptMedium-v0", "InterceptFast-v0"]  # the paper's
TASKS += ["RememberColor3-v0", "RememberColor5-v0"]
CHANCE = dict(zip(TASKS, (1 / 6, 1 / 9, None, None, 1 / 3, 1 / 5), strict=True))  # one of the objects is the right one
FIRST_REPORTED_SEED = 11
LOOKED_AT = ("RememberColor9-v0", 14)  # task and seed of a belief with which the network was chosen
LABELS = {"ppo_aib_small": "AIB", "ppo_believer_small": "Believer", "ppo_baseline_small": "PPO"}
LABELS |= {"ppo_baseline_equal": "PPO, equal cost", "aib_belief_small": "AIB"}
LABELS |= {"ppo_aib_small_none": "AIB, no head", "aib_belief_small_none": "AIB, no head"}
LABELS |= {"ppo_aib_small_mse": "AIB, MSE head", "aib_belief_small_mse": "AIB, MSE head"}
LABELS |= {"ppo_aib_small_lambda_0.1": "AIB, λ 0.1", "aib_belief_small_lambda_0.1": "AIB, λ 0.1"}
LABELS |= {"ppo_aib_small_lambda_0.01": "AIB, λ 0.01", "aib_belief_small_lambda_0.01": "AIB, λ 0.01"}
COLOURS = {"AIB": "tab:blue", "Believer": "tab:orange", "PPO": "tab:gray", "PPO, equal cost": "tab:gray"}
PROBES = {"u_r2_prior": "last step", "cue_chance": "chance of the cue", "cue_from_u": "cue from u"}
PROBES |= {"cue_from_h": "cue from h", "cue_from_particle": "cue from particles", "action_readout": "R² of a_t"}
PROBES |= {"nll_prior": "−log p(u), prior", "nll_posterior": "posterior", "flow_gain": "flow gain"}


@dataclass
class Args:
    runs: Path | None = None
    """report on this folder of run directories; none: rebuild README.md and docs/results.md"""
    add: bool = False
    """add the runs to benchmark/results, with the commit of the code that lies around their folder"""
    output: Path = Path("benchmark/report")
    """where the report on --runs goes"""


def fail(message: str) -> NoReturn:
    """Say on stderr what is wrong and what to do, and leave with exit code 2."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


# ---------------------------------------------------------------- data


def read(name: str) -> pd.DataFrame:
    """One of benchmark/results' CSV files."""
    return pd.read_csv(RESULTS / name, dtype={"commit": str, "step": "Int64"})


def read_json(file: Path) -> dict:
    """What a file holds; nothing if there is none."""
    return json.loads(file.read_text()) if file.exists() else {}


def collect(folder: Path) -> dict[str, pd.DataFrame]:
    """Rows as in eval.csv, test.csv and beliefs.csv of all runs in a folder but --quick ones.

    Beliefs are shown at every fifth time step, at 4, 9 and the last. u_r2_agent: R2 of u on the agent's test episodes.
    """
    command = ["git", "-C", str(folder), "rev-parse", "--short=7", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True).stdout.strip()
    found = {name: [] for name in COLUMNS}
    for file in sorted(folder.glob("*__*__*/args.json")):
        args, path = json.loads(file.read_text()), file.parent
        if args["quick"]:
            continue
        run = {"task": args["env_id"], "exp_name": args["exp_name"], "seed": args["seed"], "commit": commit}
        if (evals := path / "eval.csv").exists():
            found["eval.csv"] += (
                pd.read_csv(evals)
                .rename(columns={"global_step": "step"})
                .assign(steps_before=steps_before(args, folder), **run)
                .to_dict("records")
            )
        diagnosis, by_step = read_json(path / "diagnosis.json"), read_json(path / "diagnostics.json")
        if test := read_json(path / "evaluation.json"):
            swapped = read_json(path / "diagnosis_swapped.json").get("success_once")
            row = {"nearest_is_right": diagnosis.get("nearest_is_right"), "swapped_success_once": swapped}
            found["test.csv"].append(run | test | row | {"step": test["global_step"]})
        if "u_r2" in diagnosis:
            by_step["u_r2_agent"] = {int(step): value for step, value in diagnosis["u_r2"].items()}
        for metric, values in by_step.items():
            if isinstance(values, list):
                steps = sorted({*range(0, len(values), 5), 4, 9, len(values) - 1} & {*range(len(values))})
                values = {step: values[step] for step in steps}
            for step, value in values.items() if isinstance(values, dict) else [(None, values)]:
                found["beliefs.csv"].append({**run, "step": step, "metric": metric, "value": value})
    tables = {}
    for name, rows in found.items():
        rows = pd.DataFrame(rows).reindex(columns=[*RUN, "step", *COLUMNS[name]])
        whole = {"seed", "step", "steps_before"} & {*rows}
        real = {*COLUMNS[name]} - whole - {"metric"}
        tables[name] = rows.astype(dict.fromkeys(whole, "Int64") | dict.fromkeys(real, float))
    return tables


def add_to_results(runs: Path) -> None:
    """Add a folder's runs to the CSV files, in place of their former rows."""
    for name, rows in collect(runs).items():
        if "" in {*rows.commit}:
            fail(f"{runs} lies in no git repository, so the commit of its code is unknown")
        key = [*RUN, "step", *(["metric"] if name == "beliefs.csv" else [])]
        rows = pd.concat([read(name), rows])
        rows["place"] = rows.groupby(key, sort=False, dropna=False).ngroup()  # a row that is replaced keeps its own
        rows = rows.drop_duplicates("place", keep="last").sort_values("place").drop(columns="place")
        rows.to_csv(RESULTS / name, index=False, float_format=f"%.{3 if name == 'beliefs.csv' else 4}f")


def select(rows: pd.DataFrame, **chosen: object) -> pd.DataFrame:
    """The rows whose columns are as chosen."""
    for name, value in chosen.items():
        rows = rows[rows[name] == value]
    return rows


def of_blocks(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of the comparison's blocks, by their seeds."""
    looked_at = (rows.task == LOOKED_AT[0]) & (rows.seed == LOOKED_AT[1])
    return rows[(rows.seed >= FIRST_REPORTED_SEED) & ~looked_at]


def shown(rows: pd.DataFrame) -> pd.DataFrame:
    """Of each task the runs of the comparison; before there are any, the newest commit's of those of the choices."""
    rows = rows[rows.exp_name.isin(LABELS)]
    parts = [rows[:0]]
    for _, found in rows.groupby("task", sort=False):
        reported = of_blocks(found)
        parts.append(found[found.commit == found.commit.unique()[-1]] if reported.empty else reported)
    return pd.concat(parts)


def by_seed(rows: pd.DataFrame, column: str, **chosen: object) -> pd.DataFrame:
    """A column of the rows that are as chosen: a row per step, a column per seed."""
    return select(rows, **chosen).pivot(index="step", columns="seed", values=column).dropna(how="all")


def last(curves: pd.DataFrame, count: int = 1) -> pd.Series:
    """Of each seed: the last value, or the mean of the last three, the paper's summary."""
    return pd.Series({seed: curve.dropna()[-count:].mean() for seed, curve in curves.items()}, dtype=float).dropna()


def plus_minus(values: pd.Series) -> str:
    """Mean ± sample standard deviation over seeds, of which one has none."""
    if len(values) == 0:
        return ""
    return f"{values.mean():.2f}" + (f" ± {values.std(ddof=1):.2f}" if len(values) > 1 else "")


def markdown(rows: list[dict]) -> str:
    """A table, empty where a row has no value."""
    table = pd.DataFrame(rows, dtype=object).fillna("")
    cells = [table.columns, ["---"] * table.shape[1], *table.to_numpy()]
    return "\n".join(f"| {' | '.join(map(str, row))} |" for row in cells)


def number(value: float) -> str:
    """Two decimals; nothing for what is missing."""
    return "" if pd.isna(value) else f"{value:z.2f}"


def name_of(task: str) -> str:
    """Without its version."""
    return task.removesuffix("-v0")


def steps_before(args: dict, runs: Path) -> int:
    """Environment steps before a run's PPO: the random episodes of its belief, if stage 1's run is in the folder."""
    if "belief" not in args and "repr_dir" not in args:  # plain PPO
        return 0
    preset = "_small" if args.get("small") else ""
    stage_1 = read_json(runs / f"{args['env_id']}__aib_repr{preset}__{args['seed']}" / "args.json")
    return stage_1.get("num_episodes", 0) * (90 if args["env_id"].startswith("Intercept") else 60)


# ---------------------------------------------------------------- tables


def results_table(tests: pd.DataFrame) -> str:
    """README's: per task success_once / success_at_end of the last agents on test episodes, and the paper's."""
    paper, tests, rows = read("paper.csv"), shown(tests), []
    for task in TASKS:
        found = select(tests, task=task)
        if found.empty:
            continue
        chance = CHANCE[task]
        row = {"task": name_of(task), "chance": f"{chance:.2f}" if chance else ""}
        for name in ("ppo_aib_small", "ppo_believer_small", "ppo_baseline_small", "ppo_baseline_equal"):
            values = [plus_minus(select(found, exp_name=name)[metric]) for metric in METRICS]
            row[LABELS[name]] = " / ".join(values) if values[0] else ""
        row["seeds"] = ", ".join(map(str, sorted({*found.seed})))
        for method in ("AIB", "Believer", "PPO"):
            theirs = [select(paper, task=task, method=method, metric=metric) for metric in METRICS]
            row[f"paper: {method}"] = " / ".join(f"{x.iloc[0]['last']:.2f}" for x in theirs if len(x))
        rows.append(row)
    return markdown(rows)


def runs_table(evals: pd.DataFrame, tests: pd.DataFrame) -> str:
    """Each run whose last agent was tested: its last three evaluations, its test, what it owes to its belief."""
    rows = []
    for task in TASKS:
        for test in select(tests, task=task).sort_values(["seed", "commit", "exp_name"]).itertuples():
            curves = select(evals, **{name: getattr(test, name) for name in RUN})
            row = {"task": name_of(task), "run": LABELS.get(test.exp_name, test.exp_name), "seed": test.seed}
            row |= {"commit": test.commit, "PPO steps": f"{test.step:,}"}
            for metric in METRICS:
                row[metric] = plus_minus(last(by_seed(curves, metric), 3))
            for metric in METRICS:
                row[f"test: {metric}"] = number(getattr(test, metric))
            row["nearest is right"] = number(test.nearest_is_right)
            row["another episode's particles"] = number(test.swapped_success_once)
            rows.append(row)
    return markdown(rows)


def blocks_of(tests: pd.DataFrame, exp_name: str, metric: str) -> dict[str, pd.Series]:
    """By task: a metric of the comparison's blocks, by seed."""
    rows = select(of_blocks(tests), exp_name=exp_name).set_index("seed")
    return {task: rows[rows.task == task][metric] for task in TASKS if task in {*rows.task}}


def pairs_table(tests: pd.DataFrame) -> str:
    """AIB - Believer on test episodes over the blocks that have both: mean [95 % interval].

    The interval of a task is Student's t's; over tasks a bootstrap's, with blocks drawn anew within each task.
    """
    rows, rng = {}, np.random.default_rng(0)
    for metric in METRICS:
        aib, believer = (blocks_of(tests, name, metric) for name in ("ppo_aib_small", "ppo_believer_small"))
        pairs = {task: (aib[task] - believer[task]).dropna() for task in aib if task in believer}
        for task, difference in pairs.items():
            row = rows.setdefault(task, {"task": name_of(task), "pairs": len(difference)})
            row[metric] = f"{difference.mean():+z.2f}"
            if len(difference) > 1:
                low, high = scipy.stats.ttest_1samp(difference, 0).confidence_interval()
                row[metric] += f" [{low:+.2f}, {high:+.2f}]"
        if len(pairs) > 1:
            row = rows.setdefault("all", {"task": "mean over tasks", "pairs": sum(map(len, pairs.values()))})
            drawn = [rng.choice(difference, (10_000, len(difference))).mean(1) for difference in pairs.values()]
            low, high = np.quantile(np.mean(drawn, axis=0), [0.025, 0.975])
            row[metric] = f"{np.mean([x.mean() for x in pairs.values()]):+z.2f} [{low:+.2f}, {high:+.2f}]"
    return markdown([*rows.values()] or [{"task": "no block has both methods yet"}])


def plain_table(tests: pd.DataFrame) -> str:
    """A belief - plain PPO of as many steps in all: mean over tasks; p of labels permuted within each task."""
    rows, rng = [], np.random.default_rng(0)
    for name in ("ppo_aib_small", "ppo_believer_small"):
        row = {"method": LABELS[name]}
        for metric in METRICS:
            belief, plain = blocks_of(tests, name, metric), blocks_of(tests, "ppo_baseline_equal", metric)
            tasks = [task for task in belief if task in plain]
            observed, permuted = [], []
            for task in tasks:
                count, pooled = len(belief[task]), np.concatenate([belief[task], plain[task]])
                drawn = np.vstack([pooled, rng.permuted(np.tile(pooled, (10_000, 1)), axis=1)])
                difference = drawn[:, :count].mean(1) - drawn[:, count:].mean(1)
                observed.append(difference[0])
                permuted.append(difference)
            if tasks:
                p = (np.mean(permuted, axis=0) >= np.mean(observed) - 1e-9).mean()
                row |= {"tasks": len(tasks), metric: f"{np.mean(observed):+z.2f}, p = {p:.4f}"}
        if "tasks" in row:
            rows.append(row)
    return markdown(rows or [{"method": "no block has both methods yet"}])


def beliefs_table(beliefs: pd.DataFrame) -> str:
    """What each belief knows on held-out episodes: R2 of u at some time steps, all else at the last one."""
    rows = []
    order = {task: i for i, task in enumerate(TASKS)}
    runs = select(beliefs, metric="u_r2_prior")[RUN].drop_duplicates()
    for run in runs.sort_values("task", key=lambda tasks: tasks.map(order), kind="stable").to_dict("records"):
        found = select(beliefs, **run)
        label = LABELS.get(run["exp_name"], run["exp_name"])
        row = {"task": name_of(run["task"]), "belief": label, "seed": run["seed"], "commit": run["commit"]}
        r2 = select(found, metric="u_r2_prior").set_index("step").value
        for step, title in ((10, "R² of u, step 10"), (15, "step 15"), (20, "step 20")):
            row[title] = number(r2.get(step, math.nan))
        for metric, title in PROBES.items():
            values = select(found, metric=metric).sort_values("step").value
            row[title] = number(values.iloc[-1]) if len(values) else ""
        rows.append(row)
    return markdown(rows)


# ---------------------------------------------------------------- figures


def draw(axes: plt.Axes, curves: pd.DataFrame, label: str, colour: str, style: str = "-") -> None:
    """Mean over seeds at the steps all of them have, and each seed as a thin line."""
    if curves.empty:
        return
    common = curves.dropna()
    axes.plot(common.index, common.mean(axis="columns"), style, color=colour, label=label)
    if curves.shape[1] > 1:
        for _, curve in curves.items():
            curve = curve.dropna()
            axes.plot(curve.index, curve, style, color=colour, linewidth=0.8, alpha=0.4)


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


def panels(count: int, columns: int) -> tuple[plt.Figure, np.ndarray]:
    """As many panels with one y axis as are needed."""
    rows = math.ceil(count / columns)
    size = (4 * columns, 0.6 + 3 * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", sharey=True, squeeze=False)
    for ax in axes.flat[count:]:
        ax.remove()
    return figure, axes


def success_panel(ax: plt.Axes, task: str, title: str, metric: str, xlabel: str) -> None:
    """Titles and chance of a panel of learning curves."""
    if CHANCE.get(task):
        ax.axhline(CHANCE[task], color="black", linestyle=":", linewidth=1, label="chance")
    ax.set_title(title, fontsize=9)
    ax.set(xlabel=xlabel, ylabel=metric, xlim=(0, None), ylim=(-0.03, 1.03))  # curves at 0 beside the axis
    ax.xaxis.set_major_formatter(EngFormatter(sep=""))  # 100k


def learning_figure(evals: pd.DataFrame, path: Path) -> None:
    """success_once by environment steps, the random episodes of the belief included; dashed what the paper has."""
    evals, paper = shown(evals), select(read("paper.csv"), metric="success_once")
    tasks = [task for task in TASKS if task in {*evals.task}]
    figure, axes = panels(len(tasks), min(3, len(tasks)))
    for ax, task in zip(axes.flat, tasks, strict=False):
        found = select(evals, task=task)
        plain = "ppo_baseline_equal" if "ppo_baseline_equal" in {*found.exp_name} else "ppo_baseline_small"
        for name in ("ppo_aib_small", "ppo_believer_small", plain):
            label = LABELS[name].partition(",")[0]
            curves = by_seed(found, "success_once", exp_name=name)
            if not curves.empty:
                curves.index += select(found, exp_name=name).steps_before.max()
            draw(ax, curves, label, COLOURS[label])
            for row in select(paper, task=task, method=label).itertuples():
                dashed = {"linestyle": "--", "linewidth": 1, "label": f"{label}, paper, 10 M steps"}
                ax.axhline(row.last, color=COLOURS[label], **dashed)
        seeds = ", ".join(map(str, sorted({*found.seed})))
        success_panel(ax, task, f"{name_of(task)}, seed {seeds}", "success_once", "environment steps")
    save_figure(figure, axes, path)


def belief_figure(beliefs: pd.DataFrame, path: Path) -> None:
    """R2 of u from the mean particle by time step: on held-out random episodes, and on the agent's own."""
    beliefs = shown(beliefs)
    tasks = [task for task in TASKS if task in {*select(beliefs, metric="u_r2_prior").task}]
    figure, axes = panels(len(tasks), min(3, len(tasks)))
    for ax, task in zip(axes.flat, tasks, strict=False):
        for method, belief in (("ppo_aib_small", "aib_belief_small"), ("ppo_believer_small", "ppo_believer_small")):
            label = LABELS[method]
            found = select(beliefs, task=task)
            held_out = by_seed(found, "value", exp_name=belief, metric="u_r2_prior")
            draw(ax, held_out, f"{label}, held-out episodes", COLOURS[label])
            own = by_seed(found, "value", exp_name=method, metric="u_r2_agent")
            draw(ax, own, f"{label}, its agent's episodes", COLOURS[label], "--")
        ax.set_title(name_of(task), fontsize=9)
        ax.set(xlabel="time step", ylabel="R² of u", ylim=(-0.1, 1.03))
    save_figure(figure, axes, path)


def swap_figure(tests: pd.DataFrame, path: Path) -> None:
    """success_once on test episodes with the agent's own particles and, paler, with another episode's."""
    tests = shown(tests).dropna(subset="swapped_success_once")
    tasks = [task for task in TASKS if task in {*tests.task}]
    figure, axes = panels(len(tasks), min(3, len(tasks)))
    for ax, task in zip(axes.flat, tasks, strict=False):
        for place, name in enumerate(("ppo_aib_small", "ppo_believer_small")):
            found, colour = select(tests, task=task, exp_name=name), COLOURS[LABELS[name]]
            for side, column, alpha in ((-0.2, "success_once", 1.0), (0.2, "swapped_success_once", 0.4)):
                ax.bar(place + side, found[column].mean(), 0.36, color=colour, alpha=alpha)
                ax.plot(np.full(len(found), place + side), found[column], ".", color="black")
        if CHANCE.get(task):
            ax.axhline(CHANCE[task], color="black", linestyle=":", linewidth=1, label="chance")
        ax.set_title(name_of(task), fontsize=9)
        ax.set(ylabel="success_once", xlim=(-0.6, 1.6), ylim=(0, 1.03), axisbelow=True)
        ax.set_xticks([0, 1], ["AIB", "Believer"])
    save_figure(figure, axes, path)


# ---------------------------------------------------------------- pages


def rebuild(output: Path) -> None:
    """README.md, docs/results.md and their figures, below output."""
    evals, tests, beliefs = read("eval.csv"), read("test.csv"), read("beliefs.csv")
    tables = {"results": results_table(tests), "runs": runs_table(evals, tests)}
    tables |= {"pairs": pairs_table(tests), "plain": plain_table(tests), "beliefs": beliefs_table(beliefs)}
    for page in ("README.md", "docs/results.md"):
        text = (ROOT / page).read_text()
        for name, table in tables.items():
            text = re.sub(rf"(<!-- {name} -->\n).*?(<!-- end -->)", rf"\g<1>{table}\n\g<2>", text, flags=re.DOTALL)
        (output / page).write_text(text)
    learning_figure(evals, output / "benchmark" / "results" / "learning_curves.png")
    belief_figure(beliefs, output / "benchmark" / "results" / "beliefs.png")
    swap_figure(tests, output / "benchmark" / "results" / "particles.png")


def own_runs(evals: pd.DataFrame, task: str) -> str:
    """The runs of one task by exp_name, below the paper's: last values and maxima."""
    rows = []
    for row in select(read("paper.csv"), task=task).itertuples():
        values = (f"{row.last:.2f} ± {row.last_std:.2f}", f"{row.max:.2f} ± {row.max_std:.2f}")
        rows.append((row.metric, f"{row.method}, the paper's", *values))
    for exp_name, found in select(evals, task=task).groupby("exp_name"):
        steps = found.groupby("seed").step.max().min()
        for metric in METRICS:
            curves = by_seed(found, metric)
            rows.append((metric, f"{exp_name}, {steps:,} steps", plus_minus(last(curves, 3)), plus_minus(curves.max())))
    head = (task, "run", "mean of the last three", "maximum")
    return markdown([dict(zip(head, row, strict=True)) for row in sorted(rows)])


def average(evals: pd.DataFrame) -> str:
    """Each exp_name's mean over its tasks, as the paper's AVG row: of each seed that has them all."""
    rows = []
    for exp_name, found in evals.groupby("exp_name"):
        row = {"average": exp_name, "tasks": ", ".join(name_of(task) for task in sorted({*found.task}))}
        for metric in METRICS:
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
    parts, tasks = ["# Report"], sorted({*evals.task})
    colours = {name: f"C{i % 10}" for i, name in enumerate(sorted(evals.exp_name.unique()))}
    figure, axes = panels(len(METRICS) * len(tasks), len(tasks))
    for metric, row in zip(METRICS, axes, strict=True):
        for task, ax in zip(tasks, row, strict=True):
            for exp_name, runs in select(evals, task=task).groupby("exp_name"):
                draw(ax, by_seed(runs, metric), exp_name, colours[exp_name])
            success_panel(ax, task, task, metric, "PPO steps")
    save_figure(figure, axes, args.output / "learning_curves.png")
    parts += [own_runs(evals, task) for task in tasks]
    if len(tasks) > 1:
        parts.append(average(evals))
    parts.append("![success_once and success_at_end](learning_curves.png)")
    if not select(beliefs, metric="u_r2_prior").empty:
        parts.append(beliefs_table(beliefs))
    (args.output / "report.md").write_text("\n\n".join(parts) + "\n")
    print(f"{args.output / 'report.md'}: {', '.join(tasks)}")


def main(args: Args) -> None:
    """Rebuild the project's pages, report on runs, or add them to the results."""
    if args.runs is None:
        rebuild(ROOT)
    elif args.add:
        add_to_results(args.runs)
    else:
        report_runs(args)


if __name__ == "__main__":
    main(tyro.cli(Args))
