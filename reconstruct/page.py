"""Parts of a report → one HTML page that loads nothing: its style and its program are named by their hashes."""

import base64
import hashlib
import html
from collections.abc import Sequence
from importlib import resources


def page(title: str, body: Sequence[str], script: str = "") -> str:
    """The page. Its security policy lets nothing run, load or be sent but what is in it."""
    style = asset("report.css")
    allowed = {"style-src": style, "script-src": script}
    policy = "; ".join(
        ["default-src 'none'", "img-src data:", "base-uri 'none'", "form-action 'none'"]
        + [f"{kind} {_hash(content)}" for kind, content in allowed.items() if content]
    )
    if "</script" in script.lower():
        raise ValueError("the program would end its own element")
    return _PAGE.format(
        title=text(title),
        policy=policy,
        style=style,
        body="\n".join(body),
        script=f"<script>{script}</script>" if script else "",
    )


def asset(name: str) -> str:
    """A file of ``reconstruct/assets``."""
    return resources.files("reconstruct").joinpath("assets", name).read_text(encoding="utf-8")


def picture(name: str, caption: str, data: bytes, kind: str = "png") -> str:
    """A figure with a picture in it."""
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    alt = text(name.replace("-", " "))
    return f'<figure id="{name}"><img alt="{alt}" src="{source}"><figcaption>{text(caption)}</figcaption></figure>'


def cards(cards: Sequence[tuple[str, str, str]]) -> str:
    inner = "".join(
        f"<div><span>{text(label)}</span><b>{text(value)}</b><small>{text(note)}</small></div>"
        for label, value, note in cards
    )
    return f"<div class='cards'>{inner}</div>"


def table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    if not rows:
        return ""
    head = "".join(f"<th>{text(column)}</th>" for column in columns)
    body = "".join("<tr>" + "".join(f"<td>{text(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def number(value: float | None, unit: str, *, sign: bool = False) -> str:
    """Three figures and the unit; a dash for what is not known."""
    if value is None:
        return "–"
    decimals = 1 if abs(value) >= 100 or unit == "%" else 2 if abs(value) >= 0.1 or sign else 3
    space = "" if unit in ("", "°") else " "
    return f"{round(value, decimals) + 0.0:{'+' if sign else ''}.{decimals}f}{space}{unit}"


def text(value: object) -> str:
    return html.escape(str(value))


def _hash(content: str) -> str:
    digest = hashlib.sha256(content.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body><main>
{body}
</main>{script}</body>
</html>
"""
