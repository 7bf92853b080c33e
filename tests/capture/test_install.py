"""Installing into an image: everything in place, nothing twice, nothing of an administrator's lost."""

import json
import shutil

import pytest

from capture.install import FILES, RECORD, TOKEN


@pytest.fixture
def image(tmp_path):
    """A root folder with the programs in it, and what systemd-sysusers reads."""
    root = tmp_path / "image"
    (root / "opt/wingshape/bin").mkdir(parents=True)
    (root / "opt/wingshape/bin/wingcap").touch()
    (root / "etc").mkdir()
    for name in ("passwd", "group"):
        (root / f"etc/{name}").write_text("root:x:0:0::/root:/bin/sh\n" if name == "passwd" else "root:x:0:\n")
    return root


@pytest.fixture
def install(image, wingcap):
    if shutil.which("systemd-sysusers") is None:
        pytest.skip("needs the program systemd-sysusers, which is not here")

    def call(*words, command="install"):
        words = (command, "--root", image, *words, "--json")
        if command == "install":
            words = (*words, "--programs", "/opt/wingshape/bin")
        done = wingcap(*words)
        assert done.returncode == 0, done.stderr
        return {action["target"]: action["what"] for action in json.loads(done.stdout)["actions"]}

    return call


def files(image):
    return {path.relative_to(image): path.read_bytes() for path in image.rglob("*") if path.is_file()}


def test_a_dry_run_changes_nothing(install, image):
    before = files(image)
    done = install("--dry-run", "--enable")
    assert done["/etc/systemd/system/wingcap.service"] == "installed"
    assert files(image) == before


def test_everything_is_put_in_place_once(install, image):
    done = install("--enable")
    for _, target, mode in FILES:
        assert done[f"/{target}"] == "installed"
        assert (image / target).stat().st_mode & 0o777 == mode
    unit = (image / "etc/systemd/system/wingcap.service").read_text()
    assert "ExecStart=/opt/wingshape/bin/wingcap record" in unit
    assert "@BIN@" not in unit
    assert (image / TOKEN).stat().st_mode & 0o777 == 0o600
    assert len((image / TOKEN).read_text().strip()) >= 40
    assert "wingshape-monitor" in (image / "etc/passwd").read_text()
    assert (image / "etc/systemd/system/multi-user.target.wants/wingcap.service").is_symlink()
    before = files(image)
    again = install("--enable")
    assert {what for target, what in again.items() if target.startswith("/")} == {"unchanged"}
    assert files(image) == before


def test_what_was_edited_is_kept_and_what_was_not_is_updated(install, image):
    install()
    config, unit = image / "etc/wingshape/wingcap.toml", image / "etc/systemd/system/wingcap.service"
    ours = config.read_bytes()
    config.write_text("# edited\n")
    old = b"# as an older version had it\n"
    unit.write_bytes(old)
    record = json.loads((image / RECORD).read_text())
    import hashlib

    record["etc/systemd/system/wingcap.service"] = hashlib.sha256(old).hexdigest()
    (image / RECORD).write_text(json.dumps(record))
    done = install()
    assert done["/etc/wingshape/wingcap.toml"] == "kept"
    assert config.read_text() == "# edited\n"
    assert config.with_name("wingcap.toml.new").read_bytes() == ours
    assert done["/etc/systemd/system/wingcap.service"] == "updated"
    assert b"ExecStart=" in unit.read_bytes()


def test_uninstalling_leaves_what_was_edited_and_nothing_else(install, image):
    untouched = files(image)
    install("--enable")
    config = image / "etc/wingshape/wingcap.toml"
    config.write_text("# edited\n")
    done = install(command="uninstall")
    assert done["/etc/wingshape/wingcap.toml"] == "kept"
    left = {path for path in files(image) if path not in untouched}
    accounts = {path for path in left if path.parent.name == "etc"}  # users stay: recordings are theirs
    assert {path.name for path in left - accounts} == {"wingcap.toml"}
    config.unlink()
    install(command="uninstall")


def test_refusals(image, wingcap, tmp_path):
    hidden = wingcap("install", "--root", image, "--programs", "/home/me/venv/bin")
    assert hidden.returncode == 2
    assert "services do not see /home" in hidden.stderr
    missing = wingcap("install", "--root", image, "--programs", "/opt/other")
    assert missing.returncode == 2
    assert "wingcap is not there" in missing.stderr
    no_root = wingcap("install", "--root", tmp_path)
    assert no_root.returncode == 2
    assert "it has no etc" in no_root.stderr
