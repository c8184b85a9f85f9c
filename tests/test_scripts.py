"""The shape of the project: five scripts that share no code, the same words for the same thing, the method first."""

import ast
from collections import defaultdict
from dataclasses import fields

import pytest

from conftest import ROOT, SCRIPTS

SOURCES = {name: (ROOT / f"{name}.py").read_text() for name in SCRIPTS}
TREES = {name: ast.parse(source) for name, source in SOURCES.items()}
SECTIONS = ["arguments", "networks", "losses", "warm-up", "data", "evaluation", "training", "simulator", "files"]
OWN = ("Args", "main", "evaluate_checkpoint", "SMALL", "QUICK", "LIMITS", "MAY_DIFFER", "TASKS")


def test_what_two_scripts_have_in_common_has_one_default() -> None:
    defaults = defaultdict(set)
    for name in ("aib_belief", "ppo_aib", "ppo_believer", "ppo_baseline"):
        for field in fields(SCRIPTS[name].Args):
            if field.name != "exp_name":
                defaults[field.name].add(field.default)
    assert {name: values for name, values in defaults.items() if len(values) > 1} == {}


def test_defaults_are_those_of_the_papers_tables_2_to_4() -> None:
    belief = SCRIPTS["aib_belief"].Args()
    values = (belief.belief_lr, belief.num_updates, belief.batch_episodes, belief.z_dim, belief.beta)
    assert (*values, belief.action_lambda) == (3e-4, 10_000, 256, 32, 1.0, 1.0)
    stage_1 = SCRIPTS["aib_repr"].Args()
    assert (stage_1.learning_rate, stage_1.epochs, stage_1.batch_size, stage_1.u_dim) == (3e-4, 200, 500, 16)
    coefficients = (stage_1.reward_coef, stage_1.state_coef, stage_1.obs_coef, stage_1.kl_coef)
    assert coefficients == (10.0, 0.3, 0.03, 0.03)


def test_no_script_imports_another() -> None:
    for name, tree in TREES.items():
        for node in ast.walk(tree):
            imported = []
            if isinstance(node, ast.Import):
                imported = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                imported = [node.module or "."]
            assert not {module.split(".")[0] for module in imported} & set(SCRIPTS), name


def test_what_has_one_name_is_one_text() -> None:
    copies = defaultdict(dict)
    for script, tree in TREES.items():
        for node in tree.body:
            text = ast.get_source_segment(SOURCES[script], node)  # comments too
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name not in OWN:
                copies[node.name][script] = text
            elif (
                isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id not in OWN
            ):
                copies[node.targets[0].id][script] = text
    assert len(copies["load"]) == 5, "the comparison sees the copies"
    for name in ("Agent", "rollout", "evaluate"):  # plain PPO's are the same thing without a belief
        del copies[name]["ppo_baseline"]
    differ = {name: list(scripts) for name, scripts in copies.items() if len(set(scripts.values())) > 1}
    assert not differ


@pytest.mark.parametrize("script", SCRIPTS)
def test_the_method_comes_first_and_the_loop_is_in_main(script: str) -> None:
    lines = SOURCES[script].splitlines()
    titles = [line.removeprefix("# ").strip("- ") for line in lines if line.startswith("# -----")]
    missing = {"aib_repr": {"evaluation", "warm-up"}, "aib_belief": {"simulator"}, "ppo_believer": set()}
    assert titles == [section for section in SECTIONS if section not in missing.get(script, {"warm-up"})]
    ends = {
        node.name: node.end_lineno for node in TREES[script].body if isinstance(node, ast.FunctionDef | ast.ClassDef)
    }
    method = {"aib_repr": "repr_losses", "aib_belief": "belief_losses"}.get(script, "ppo_losses")
    (data,) = (i for i, line in enumerate(lines) if line.startswith("# -----") and line.endswith("- data"))
    assert ends[method] <= data
    (main,) = (node for node in TREES[script].body if isinstance(node, ast.FunctionDef) and node.name == "main")
    called = {node.func.attr for node in ast.walk(main) if isinstance(node, ast.Call) and hasattr(node.func, "attr")}
    assert {"backward", "step", "zero_grad"} <= called and main.end_lineno - main.lineno <= 109


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_argument_is_used_and_documented(script: str) -> None:
    (args,) = (node for node in TREES[script].body if isinstance(node, ast.ClassDef) and node.name == "Args")
    for field, text in zip(args.body[::2], args.body[1::2], strict=True):
        assert isinstance(text.value, ast.Constant) and text.value.value, field.target.id
    used = {
        node.attr
        for node in ast.walk(TREES[script])
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "args"
    }
    handed_on = {  # by name, to an earlier stage or to what reads the arguments
        "aib_belief": set(),
        "aib_repr": set(),
        "ppo_aib": set(),
        "ppo_baseline": set(),
        "ppo_believer": set(),
    }[script]
    assert {field.target.id for field in args.body[::2]} - used == handed_on
