"""``wingcap install`` and ``wingcap uninstall``: the systemd files, put in place and taken away by command."""

from pathlib import Path
from typing import Annotated

import typer

from capture.console import say, say_json
from capture.install import Action, own_programs
from capture.install import install as put_in_place
from capture.install import uninstall as take_away

Root = Annotated[Path, typer.Option(help="the system's root folder, or an image's")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="only say what would be done")]
Json = Annotated[bool, typer.Option("--json", help="print the result as JSON")]


def install(
    root: Root = Path("/"),
    programs: Annotated[
        Path | None, typer.Option(help="folder of wingcap and wingproc inside that root; without it, of this wingcap")
    ] = None,
    enable: Annotated[bool, typer.Option("--enable", help="start recorder and monitor at every boot")] = False,
    dry_run: DryRun = False,
    json: Json = False,
) -> None:
    """Put units, users, udev rules, kernel settings and a configuration to start from in place, and say what was done.

    A second time changes nothing. A file that was edited is kept, and ours put beside it as `.new`.
    """
    actions = put_in_place(root, programs or own_programs(), enable, dry_run)
    _tell(actions, dry_run, json)
    if not json and not dry_run:
        say(
            "next: edit /etc/wingshape/wingcap.toml, check it with "
            "`wingcap preflight --config /etc/wingshape/wingcap.toml`"
            + (", and start the computer anew" if enable else ", then `systemctl enable --now wingcap wingcap-monitor`")
        )


def uninstall(root: Root = Path("/"), dry_run: DryRun = False, json: Json = False) -> None:
    """Stop the services and take away what `wingcap install` has put in place, but for files that were edited.

    Recordings, users and mounted disks stay.
    """
    _tell(take_away(root, dry_run), dry_run, json)


def _tell(actions: list[Action], dry_run: bool, json: bool) -> None:
    if json:
        say_json(
            {
                "dry_run": dry_run,
                "actions": [{"what": a.what, "target": a.target, "remark": a.remark} for a in actions],
            }
        )
        return
    for action in actions:
        say(f"{'would be ' if dry_run and action.what != 'unchanged' else ''}{action}")
