"""Tables 1, 6, 7, 8 and Figures 2, 3, 4, 8 of the paper from finished runs, beside the paper's own numbers.

With --small, the --small runs on whatever tasks there are: a table and a figure of the three methods, and a table and a
figure of what their beliefs remember.

Usage:   python benchmark/report.py                 (reads runs/, writes benchmark/report/)
         python benchmark/report.py --small --runs benchmark/results --output benchmark/results   (the README's figure)
Reads:   {runs}/{env_id}__{exp_name}__{seed}/: args.json; eval.csv of the PPO scripts, diagnostics.json of the beliefs
Writes:  {output}/report.md (small.md) and PNG figures
"""

import csv
import json
import sys
import textwrap
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

TASKS = {
    "RememberShapeAndColor3x2-v0": "RSC3x2",
    "RememberColor9-v0": "RC9",
    "InterceptMedium-v0": "IMed",
    "InterceptFast-v0": "IFast",
}
METHODS = {"ppo_aib": "AIB", "ppo_believer": "Believer", "ppo_baseline": "PPO"}
COLOURS = {"ppo_aib": "tab:red", "ppo_believer": "tab:blue", "ppo_baseline": "tab:green"}
HEADS = {"ppo_aib": "flow matching", "ppo_aib_none": "no action head", "ppo_aib_mse": "MSE regression"}
BELIEFS = {  # action_head in args.json, which Believer has not
    "flow": "AIB, flow matching",
    "mse": "AIB, MSE regression",
    "none": "AIB, no action head",
    None: "Believer",
}
BELIEF_DEFAULTS = {
    "fm_latent": "mean",
    "history_joints": True,
    "action_lambda": 1.0,
    "image_norm": "mean",
    "beta": 1.0,
    "image_shift": 0,
}
BELIEF_COLUMNS = {  # of diagnostics.json
    "cue from h": "cue_from_h",
    "cue from the mean particle": "cue_from_particle",
    "R² of u, mean particle": "u_r2_prior",
    "−log p(u), prior": "nll_prior",
    "posterior": "nll_posterior",
    "R² of a_t": "action_readout",
    "L_FM": "flow_loss",
    "flow gain": "flow_gain",
}
LAMBDAS = {"ppo_aib": "λ = 1", "ppo_aib_lambda_0.1": "λ = 0.1", "ppo_aib_lambda_0.01": "λ = 0.01"}
PAPER = {  # (column of eval.csv, statistic): {task: (AIB, Believer, PPO)}
    ("success_once", "last"): {
        "RSC3x2": ("0.82 ± 0.04", "0.76 ± 0.02", "0.04 ± 0.02"),
        "RC9": ("0.36 ± 0.07", "0.35 ± 0.03", "0.17 ± 0.03"),
        "IMed": ("0.54 ± 0.06", "0.56 ± 0.10", "0.70 ± 0.14"),
        "IFast": ("0.67 ± 0.07", "0.52 ± 0.14", "0.01 ± 0.01"),
    },
    ("success_at_end", "last"): {
        "RSC3x2": ("0.81 ± 0.03", "0.74 ± 0.04", "0.01 ± 0.01"),
        "RC9": ("0.25 ± 0.06", "0.21 ± 0.01", "0.10 ± 0.01"),
        "IMed": ("0.17 ± 0.04", "0.11 ± 0.03", "0.02 ± 0.02"),
        "IFast": ("0.09 ± 0.03", "0.08 ± 0.02", "0.00 ± 0.00"),
    },
    ("success_once", "max"): {
        "RSC3x2": ("0.87 ± 0.01", "0.82 ± 0.01", "0.14 ± 0.03"),
        "RC9": ("0.41 ± 0.08", "0.38 ± 0.03", "0.20 ± 0.02"),
        "IMed": ("0.68 ± 0.01", "0.65 ± 0.07", "0.71 ± 0.13"),
        "IFast": ("0.77 ± 0.06", "0.69 ± 0.12", "0.02 ± 0.02"),
    },
    ("success_at_end", "max"): {
        "RSC3x2": ("0.86 ± 0.01", "0.80 ± 0.02", "0.04 ± 0.01"),
        "RC9": ("0.28 ± 0.05", "0.23 ± 0.02", "0.15 ± 0.02"),
        "IMed": ("0.23 ± 0.02", "0.18 ± 0.03", "0.03 ± 0.01"),
        "IFast": ("0.14 ± 0.01", "0.12 ± 0.02", "0.00 ± 0.00"),
    },
}
TITLES = {
    ("success_once", "last"): "Table 1: success_once, mean of the last three evaluations",
    ("success_at_end", "last"): "Table 6: success_at_end, mean of the last three evaluations",
    ("success_once", "max"): "Table 7: success_once, maximum over evaluations",
    ("success_at_end", "max"): "Table 8: success_at_end, maximum over evaluations",
}
PAPER_LAMBDAS = {
    "ppo_aib": "0.666 ± 0.072",
    "ppo_aib_lambda_0.1": "0.623 ± 0.081",
    "ppo_aib_lambda_0.01": "0.446 ± 0.011",
}


@dataclass
class Args:
    runs: Path = Path("runs")
    """folder of run directories"""
    output: Path = Path("benchmark/report")
    """folder for report.md and the figures"""
    small: bool = False
    """report the --small runs"""


@dataclass
class Run:
    """One seed: the columns of eval.csv as arrays, and whether the run is finished."""

    seed: int
    finished: bool
    quick: bool
    share: float
    columns: dict[str, np.ndarray]


def read_runs(folder: Path) -> dict[tuple[str, str], list[Run]]:
    """Every run with an eval.csv below folder, by task and experiment name, seeds in order."""
    runs = defaultdict(list)
    for file in sorted(folder.glob("*__*__*/eval.csv")):
        args = json.loads((file.parent / "args.json").read_text())
        rows = list(csv.DictReader(file.open()))
        columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
        share = columns["global_step"][-1] / args["total_timesteps"]
        per_iteration = columns["global_step"][-1] / columns["iteration"][-1]
        finished = columns["global_step"][-1] + per_iteration > args["total_timesteps"]
        runs[args["env_id"], args["exp_name"]].append(Run(args["seed"], finished, args["quick"], share, columns))
    return {key: sorted(found, key=lambda run: run.seed) for key, found in runs.items()}


def statistic(run: Run, column: str, which: str) -> float:
    """The paper's summary of one run: mean of the last three evaluations, or the maximum."""
    values = run.columns[column]
    return float(values[-3:].mean() if which == "last" else values.max())


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of the middle half of the values; runs at the edge of it count in part."""
    values, quarter = np.sort(values), len(values) / 4
    places = np.arange(len(values))
    weights = np.clip(np.minimum(places + 1, len(values) - quarter) - np.maximum(places, quarter), 0, 1)
    return float((weights * values).sum() / weights.sum())


def summarise(values: list[float]) -> str:
    """Mean ± sample standard deviation over seeds; from three on also the interquartile mean with a 95 % interval."""
    x = np.array(values)
    if len(x) == 1:
        return f"{x[0]:.2f} (1 seed)"
    text = f"{x.mean():.2f} ± {x.std(ddof=1):.2f} ({len(x)} seeds)"
    if len(x) > 2:
        rng = np.random.default_rng(0)
        low, high = np.quantile([interquartile_mean(rng.choice(x, len(x))) for _ in range(2000)], [0.025, 0.975])
        text += f", IQM {interquartile_mean(x):.2f} [{low:.2f}, {high:.2f}]"
    return text


def cell(runs: list[Run] | None, column: str, which: str) -> str:
    """What the table says of one task and method: numbers, and what is missing, unfinished or only a trial."""
    if not runs:
        return "missing"
    done = [statistic(run, column, which) for run in runs if run.finished and not run.quick]
    going = [run for run in runs if not run.finished]
    notes = [f"seed {run.seed} unfinished ({run.share:.0%}): {statistic(run, column, which):.2f}" for run in going]
    notes += [f"seed {run.seed} is a --quick trial" for run in runs if run.finished and run.quick]
    return "; ".join(([summarise(done)] if done else []) + notes)


def main_table(runs: dict, key: tuple[str, str]) -> str:
    """One of the paper's four tables in Markdown, ours beside the paper's."""
    head = "| task | " + " | ".join(f"{name} | {name} (paper's)" for name in METHODS.values()) + " |"
    lines = [f"## {TITLES[key]}", "", head, "|" + "---|" * 7]
    for task, short in TASKS.items():
        cells = [(cell(runs.get((task, name)), *key), PAPER[key][short][i]) for i, name in enumerate(METHODS)]
        lines.append(f"| {short} | " + " | ".join(f"{ours} | {paper}" for ours, paper in cells) + " |")
    return "\n".join(lines)


def read_beliefs(folder: Path) -> dict[str, dict[tuple[str, str], list[dict]]]:
    """diagnostics.json of every --small belief below folder, a list over seeds by task and (method, setting).

    Both are read from args.json; a "note" in it tells what stage 2's arguments cannot.
    """
    found = defaultdict(lambda: defaultdict(list))
    for file in sorted(folder.glob("*_small*__*/diagnostics.json")):
        args = json.loads((file.parent / "args.json").read_text())
        head, size = args.get("action_head"), (args["num_episodes"], args["num_updates"])
        setting = f"{size[0]:,} episodes, {size[1]:,} updates"
        for name, default in BELIEF_DEFAULTS.items():
            if args.get(name, default) != default:
                setting += f", {name} {args[name]}"
        if "note" in args:
            setting += f", {args['note']}"
        place = size, setting, list(BELIEFS).index(head)  # rows in this order
        found[args["env_id"]][*place, BELIEFS[head]].append(json.loads(file.read_text()))
    return {task: {(key[3], key[1]): rows[key] for key in sorted(rows)} for task, rows in found.items()}


def belief_cell(reports: list[dict], column: str) -> str:
    """Numbers by step where there are such, mean over seeds and from two on their sample deviation."""
    if column not in reports[0]:
        return "–"
    values = [r[column] if isinstance(r[column], list) else [r[column]] for r in reports]
    steps = [4, 9, 30, -1] if len(values[0]) > 1 else [0]
    cells = []
    for step in steps:
        x = np.array([row[step] for row in values])
        cells.append(f"{x.mean():.2f}" + (f" ± {x.std(ddof=1):.2f}" if len(x) > 1 else ""))
    return " / ".join(cells)


def belief_table(task: str, rows: dict[tuple[str, str], list[dict]]) -> str:
    """What the beliefs of one task remember of held-out episodes, in Markdown."""
    first = next(iter(rows.values()))[0]
    head = f"{task}: steps 4 / 9 / 30 / last; cue: chance {first['cue_chance']:.2f}"
    lines = [
        head,
        "",
        "| belief | seeds | " + " | ".join(BELIEF_COLUMNS) + " |",
        "|" + "---|" * (len(BELIEF_COLUMNS) + 2),
    ]
    for (method, setting), reports in rows.items():
        cells = [belief_cell(reports, column) for column in BELIEF_COLUMNS.values()]
        lines.append(f"| {method}, {setting} | {len(reports)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def belief_figure(beliefs: dict, path: Path) -> None:
    """Cue and R² of u from the mean particle against the time step, three tasks in a row, mean ± std over seeds.

    Of each task the setting that most beliefs share, or all of them where no two beliefs share one; dashed the flow
    belief of any setting that knows most of u at the last step.
    """
    height = -(-len(beliefs) // 3)
    figure = plt.figure(figsize=(15, 6.5 * height), layout="constrained")
    for part, (task, rows) in zip(figure.subfigures(height, 3, squeeze=False).flat, beliefs.items(), strict=False):
        axes, beliefs_of = part.subplots(2, 1), Counter()
        for (_, setting), reports in rows.items():
            beliefs_of[setting] += len(reports)
        flow = [row for row in rows if row[0] == BELIEFS["flow"]]
        best = max(flow, key=lambda row: np.mean([report["u_r2_prior"][-1] for report in rows[row]]), default=None)
        for ax, name, title in zip(axes, ("cue_from_particle", "u_r2_prior"), ("cue", "R² of u"), strict=True):
            for (method, setting), reports in rows.items():
                shared = beliefs_of[setting] == max(beliefs_of.values())
                if shared or (method, setting) == best:
                    values = np.array([report[name] for report in reports])
                    mean, spread = values.mean(0), values.std(0, ddof=len(reports) > 1)
                    label = textwrap.fill(f"{method}, {setting} ({len(reports)})", 60)
                    (line,) = ax.plot(mean, "-" if shared else "--", label=label)
                    ax.fill_between(range(len(mean)), mean - spread, mean + spread, color=line.get_color(), alpha=0.2)
            ax.set(xlabel="step", ylabel=title, ylim=(-0.3, 1.05))
            ax.grid(alpha=0.3)
        axes[0].axhline(next(iter(rows.values()))[0]["cue_chance"], color="grey", linestyle=":", label="chance")
        axes[0].set_title(task)
        part.legend(*axes[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def small_report(runs: dict, beliefs: dict, output: Path) -> None:
    """small.md, small.png and belief.png: every task that was run with --small."""
    tasks = sorted({task for task, _ in runs})
    lines = ["# Runs with --small", "", "| task | measure | " + " | ".join(METHODS.values()) + " |", "|" + "---|" * 5]
    figure, axes = plt.subplots(1, len(tasks), figsize=(5 * len(tasks) + 1, 4), layout="constrained", squeeze=False)
    for ax, task in zip(axes[0], tasks, strict=True):
        for column, which in PAPER:
            cells = [cell(runs.get((task, f"{name}_small")), column, which) for name in METHODS]
            measure = f"{column}, {'mean of the last three' if which == 'last' else 'maximum'}"
            lines.append(f"| {task} | {measure} | " + " | ".join(cells) + " |")
        refreshed = [runs.get((task, f"{name}_refreshed_small")) for name in METHODS]
        if any(refreshed):
            cells = [cell(found, "success_once", "last") if found else "–" for found in refreshed]
            lines.append(f"| {task} | the first of these, belief refreshed (refresh.py) | " + " | ".join(cells) + " |")
        for (method, label), found in zip(METHODS.items(), refreshed, strict=True):
            draw(ax, runs.get((task, f"{method}_small")), "success_once", label, COLOURS[method])
            if found:
                draw(ax, found, "success_once", f"{label}, belief refreshed", COLOURS[method], "--")
        ax.set_title(task)
    finish(figure, axes[0], "success_once", output / "small.png")
    lines += ["", "![success_once](small.png)", ""]
    if beliefs:
        belief_figure(beliefs, output / "belief.png")
        shown = "The figure shows of each task the setting that most beliefs share and, dashed, the flow belief of any "
        shown += "setting that knows most of u at the last step; in brackets: seeds."
        lines += ["# What the beliefs remember of held-out episodes", "", shown, ""]
        lines += ["![cue and u from the mean particle](belief.png)"]
        lines += ["\n" + belief_table(task, rows) for task, rows in beliefs.items()]
    (output / "small.md").write_text("\n".join(lines) + "\n")
    print(f"{output / 'small.md'}: {', '.join(tasks)}")


def variant_table(runs: dict, title: str, variants: dict[str, str], paper: dict[str, str]) -> str:
    """An ablation on InterceptFast-v0: success_once, mean of the last three evaluations."""
    lines = [f"## {title}", "", "| variant | success_once | paper's |", "|---|---|---|"]
    for name, label in variants.items():
        ours = cell(runs.get(("InterceptFast-v0", name)), "success_once", "last")
        lines.append(f"| {label} | {ours} | {paper.get(name, 'only a figure')} |")
    return "\n".join(lines)


def draw(axes: plt.Axes, runs: list[Run] | None, column: str, label: str, colour: str | None, style: str = "-") -> None:
    """One learning curve: mean over seeds at the steps all of them have, shaded by the standard deviation."""
    runs = [run for run in runs or [] if not run.quick]
    if not runs:
        axes.plot([], [], color=colour, label=f"{label} (missing)")
        return
    length = min(len(run.columns["global_step"]) for run in runs)
    steps = runs[0].columns["global_step"][:length]
    values = np.stack([run.columns[column][:length] for run in runs])
    seeds = "1 seed" if len(runs) == 1 else f"{len(runs)} seeds"
    unfinished = "" if all(run.finished for run in runs) else ", unfinished"
    (line,) = axes.plot(steps, values.mean(0), style, color=colour, label=f"{label} ({seeds}{unfinished})")
    if len(runs) > 1:
        spread = values.std(0, ddof=1)
        axes.fill_between(steps, values.mean(0) - spread, values.mean(0) + spread, color=line.get_color(), alpha=0.2)


def finish(figure: plt.Figure, axes: np.ndarray, column: str, path: Path) -> None:
    """Label the axes and save the figure."""
    for ax in axes:
        ax.set(xlabel="environment steps", ylabel=column, ylim=(-0.02, 1.02))
        if not any(len(line.get_xdata()) for line in ax.lines):
            ax.set_xticks([])  # no runs, no scale
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(args: Args) -> None:
    """Write the report; fails with one sentence when there is no run to report on."""
    runs = read_runs(args.runs)
    if args.small:
        runs = {(task, name): found for (task, name), found in runs.items() if name.endswith("_small")}
    if not runs:
        kind = "eval.csv of a --small run" if args.small else "eval.csv"
        print(f"error: no {kind} below {args.runs}; name the folder of run directories with --runs", file=sys.stderr)
        sys.exit(2)
    args.output.mkdir(parents=True, exist_ok=True)
    if args.small:
        small_report(runs, read_beliefs(args.runs), args.output)
        return
    for column, name in (("success_once", "figure_2.png"), ("success_at_end", "figure_8.png")):
        figure, axes = plt.subplots(1, 4, figsize=(18, 4), layout="constrained")
        for ax, (task, short) in zip(axes, TASKS.items(), strict=True):
            for method, label in METHODS.items():
                draw(ax, runs.get((task, method)), column, label, COLOURS[method])
            ax.set_title(short)
        finish(figure, axes, column, args.output / name)
    for variants, name in ((HEADS, "figure_3.png"), (LAMBDAS, "figure_4.png")):
        figure, ax = plt.subplots(figsize=(6, 4), layout="constrained")
        for method, label in variants.items():
            draw(ax, runs.get(("InterceptFast-v0", method)), "success_once", label, None)
        ax.set_title("InterceptFast-v0")
        finish(figure, [ax], "success_once", args.output / name)
    parts = ["# Report", "Columns marked (paper's) are the paper's numbers, all others were measured in these runs."]
    parts += [main_table(runs, key) for key in TITLES]
    parts += ["![success_once](figure_2.png)", "![success_at_end](figure_8.png)"]
    parts += [variant_table(runs, "Figure 3: action heads on InterceptFast-v0", HEADS, {}), "![heads](figure_3.png)"]
    parts += [variant_table(runs, "Figure 4: weight of the flow loss on InterceptFast-v0", LAMBDAS, PAPER_LAMBDAS)]
    parts += ["![weights](figure_4.png)"]
    (args.output / "report.md").write_text("\n\n".join(parts) + "\n")
    print(f"{args.output / 'report.md'}: {sum(map(len, runs.values()))} runs")


if __name__ == "__main__":
    main(tyro.cli(Args))
