"""The shape of the project: five scripts that share no code, and the same words for the same thing."""

import ast
from collections import defaultdict

import pytest

from conftest import ROOT, SCRIPTS

TREES = {name: ast.parse((ROOT / f"{name}.py").read_text()) for name in SCRIPTS}


def test_no_script_imports_another() -> None:
    for name, tree in TREES.items():
        for node in ast.walk(tree):
            imported = []
            if isinstance(node, ast.Import):
                imported = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                imported = [node.module or "."]
            assert not {module.split(".")[0] for module in imported} & set(SCRIPTS), name


def test_what_has_one_name_is_one_code() -> None:
    copies = defaultdict(dict)
    for script, tree in TREES.items():
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name not in ("Args", "main"):
                copies[node.name][script] = ast.dump(node)
            elif isinstance(node, ast.Assign) and node.targets[0].id not in ("DEFAULTS", "QUICK"):
                copies[node.targets[0].id][script] = ast.dump(node)
    assert len(copies["load"]) == 5, "the comparison sees the copies"
    differ = {name: list(scripts) for name, scripts in copies.items() if len(set(scripts.values())) > 1}
    assert not differ


@pytest.mark.parametrize("script", SCRIPTS)
def test_public_code_is_documented(script: str) -> None:
    assert ast.get_docstring(TREES[script])
    for node in ast.walk(TREES[script]):
        if isinstance(node, ast.ClassDef) and node.name != "Args":
            assert ast.get_docstring(node), node.name
    for node in TREES[script].body:
        if isinstance(node, ast.FunctionDef):
            assert ast.get_docstring(node), node.name


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_argument_is_used_and_documented(script: str) -> None:
    (args,) = (node for node in TREES[script].body if isinstance(node, ast.ClassDef) and node.name == "Args")
    source = (ROOT / f"{script}.py").read_text()
    for field, text in zip(args.body[::2], args.body[1::2], strict=True):
        name = field.target.id
        assert isinstance(text.value, ast.Constant) and text.value.value, name
        passed_on = f'"{name}"' in source  # run_stage hands some arguments to the earlier stage by name
        assert f"args.{name}" in source or passed_on, name
