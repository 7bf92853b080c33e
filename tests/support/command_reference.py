"""The commands' own words to docs/reference/commands.md. ``make docs`` writes it, a test holds it to the commands."""

import importlib
import inspect
from pathlib import Path
from typing import Any

import typer

PAGE = Path(__file__).parents[2] / "docs/reference/commands.md"
COMMANDS = {"wingcap": "capture", "wingproc": "process", "reconstruct": "reconstruct", "wingsim": "hw_sim"}


def render() -> str:
    """The page."""
    lines = [
        "# Commands",
        "",
        "Generated from the commands themselves by `make docs`. Each takes `--help`. Exit codes: 0 done, 1 failed,",
        "2 wrong usage; `wingcap recover` also 3, partial.",
    ]
    for command, package in COMMANDS.items():
        group: Any = typer.main.get_command(importlib.import_module(f"{package}.cli").app)
        lines += ["", f"## {command}", "", _text(group.help)]
        for name, sub in sorted(group.commands.items()):
            lines += ["", f"### {command} {name}", "", _text(sub.help), ""]
            lines += [_parameter(parameter) for parameter in sub.params if parameter.name != "help"]
    return "\n".join(lines).replace("\n\n\n", "\n\n").rstrip() + "\n"


def _text(text: str | None) -> str:
    return inspect.cleandoc(text or "")


def _parameter(parameter: Any) -> str:
    names = [*parameter.opts, *parameter.secondary_opts]
    if parameter.param_type_name == "argument":
        names = [(parameter.metavar or parameter.name).upper() + (" …" if parameter.nargs == -1 else "")]
    words = "/".join(f"`{name}`" for name in names)
    default = parameter.default
    shown = default is not None and default is not False and not callable(default) and default not in ("", ())
    detail = "required" if parameter.required else f"default {default}" if shown else ""
    said = " ".join(_text(getattr(parameter, "help", None)).split())
    return f"- {words}" + (f": {said}" if said else "") + (f" ({detail})" if detail else "")


if __name__ == "__main__":
    PAGE.write_text(render(), encoding="utf-8")
