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
    known = {line.removeprefix("### ") for line in render().splitlines() if line.startswith("### ")}
    for page in PAGES:
        for command, sub in re.findall(
            r"^(?:\$ )?(wingcap|wingproc|wingsim) ([a-z]+)", page.read_text(encoding="utf-8"), re.MULTILINE
        ):
            assert f"{command} {sub}" in known, f"{page.name} names `{command} {sub}`"
