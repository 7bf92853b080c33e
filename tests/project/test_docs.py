"""What the documents say exists, exists."""

import re
from pathlib import Path

import pytest
from command_reference import PAGE, render

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


def test_the_command_reference_is_what_the_commands_say():
    assert PAGE.read_text(encoding="utf-8") == render(), "run `make docs`"


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)\)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http://", "https://", "mailto:")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_every_command_in_the_documents_exists():
    """Commands at the start of a line, and their options up to the line's end or comment."""
    known: dict[str, str] = {}
    for block in render().split("\n### ")[1:]:
        name, text = block.split("\n", 1)
        known[name] = text
    seen = 0
    for page in (page for page in PAGES if page != PAGE):
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        for command, sub, rest in re.findall(
            r"^\s*(?:\$ )?(wingcap|wingproc|wingsim|reconstruct) (\S+)([^\n#]*)", text, re.MULTILINE
        ):
            if not re.fullmatch("[a-z]+", sub):  # `reconstruct FLIGHT …` is short for `reconstruct run`
                sub = "run"
            if command == "reconstruct" and f"reconstruct {sub}" not in known:
                continue  # prose
            assert f"{command} {sub}" in known, f"{page.name} names `{command} {sub}`"
            for option in re.findall(r"(?<![\w-])--?[a-z][a-z0-9-]*", rest.split("`")[0]):
                assert f"`{option}`" in known[f"{command} {sub}"], f"{page.name} names `{command} {sub} {option}`"
            seen += 1
    assert seen > 10
