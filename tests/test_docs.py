"""What the pages name exists: links, files, make targets, flags."""

import re
import sys
from dataclasses import fields

import pytest

from conftest import ROOT, SCRIPTS

sys.path.append(str(ROOT / "benchmark"))
import belief  # noqa: E402
import diagnose_agent
import experiments
import report
import true_state

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
OTHER_FLAGS = {"--no-index", "--color-words", "--logdir", "--help"}  # of git, TensorBoard, tyro
OTHER_FLAGS |= {"--no-deps", "--ignore-requires-python", "--force-reinstall"}  # of pip
OTHER_FLAGS |= {"--method"}  # of the examples


def known_flags() -> set[str]:
    """Every flag of the scripts and of the benchmark's commands, with --no- for what is true or false."""
    flags = set(OTHER_FLAGS)
    for module in (*SCRIPTS.values(), belief, diagnose_agent, experiments, report, true_state):
        for field in fields(module.Args):
            name = field.name.replace("_", "-")
            flags |= {f"--{name}", f"--no-{name}"}
    return flags


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_files_and_flags_of_a_page(page: object) -> None:
    text = page.read_text()
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", text):
        assert (page.parent / target).exists(), f"{page.name} links to {target}"
    for script in re.findall(r"\b((?:benchmark/|docs/|tests/)?[\w/]+\.(?:py|sh))\b", text):
        found = [folder for folder in (ROOT, ROOT / "benchmark", page.parent) if (folder / script).exists()]
        assert found, f"{page.name} names {script}"
    for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", text):
        assert flag in known_flags(), f"{page.name} names {flag}"
    for target in re.findall(r"(?:^|`|sudo )make ([a-z-]+)", text, re.MULTILINE):
        assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE), f"{page.name}: make {target}"
