"""The doctor looks at everything and names one command for each lack."""

import json
import sys

import pytest

from workbench import doctor
from workbench.doctor import Check
from workbench.store import add_to_manifest


def test_whole_report_has_a_line_for_each_check():
    checks = doctor.run()
    told = doctor.report(checks)
    for name in ("python", "torch", "warp", "cores", "drawing (GL)", "browser", "disk", "extra assets", "assets"):
        assert name in told
    assert told.count("mend it with:") == sum(not check.well for check in checks)
    assert next(check for check in checks if check.name == "torch").well


def test_report_puts_the_mending_below_the_lack():
    told = doctor.report([Check("a", "fine"), Check("bc", "gone", mend="make bc")])
    assert told.splitlines() == ["ok  a   fine", "NO  bc  gone", "        mend it with: make bc", "1 of 2 are missing"]
    assert doctor.report([Check("a", "fine")]).endswith("everything is here")


def test_package_that_does_not_load_is_told(monkeypatch, tmp_path):
    (tmp_path / "half_installed.py").write_text("raise OSError('libcudart.so is missing\\nmore')")
    monkeypatch.syspath_prepend(tmp_path)
    check = doctor.package("half_installed", "pip install it")
    assert (check.found, check.mend) == ("does not load: libcudart.so is missing", "pip install it")


def test_missing_gl_is_told(monkeypatch, tmp_path):
    """A child that dies as VTK does without GL."""
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\necho 'a test picture ended its process' >&2\nkill -SEGV $$\n")
    fake.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(fake))
    check = doctor.drawing()
    assert not check.well
    assert check.found == "a test picture ended its process"
    assert check.mend == "apt-get install -y libgl1 libegl1 libxrender1"


def test_slow_gl_is_told(monkeypatch, tmp_path):
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\nexec sleep 5\n")
    fake.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(fake))
    monkeypatch.setattr(doctor, "DRAWING_PATIENCE", 0.2)
    assert "longer than 0.2 s" in doctor.drawing().found


def test_missing_things_name_their_command(monkeypatch, tmp_path):
    assert doctor.browser(["no-such-browser"]).mend == "apt-get install -y chromium"
    assert doctor.disk(tmp_path / "not" / "there", enough=1e9).mend.startswith("export WORKBENCH_CACHE=")
    assert doctor.disk(tmp_path, enough=0.0).well
    monkeypatch.setitem(doctor.EXTRAS, "lab", ("json", "no_such_module"))
    check = doctor.extra("lab")
    assert (check.found, check.mend) == ("lacks no_such_module", "pip install -c constraints.txt -e '.[lab]'")
    monkeypatch.setattr(doctor, "OLDEST_PYTHON", (99, 0))
    assert doctor.python().mend == "apt-get install -y python99.0"


@pytest.mark.parametrize("damage", ["absent", "broken", "changed", "none"])
def test_shipped_files_are_checked(tmp_path, damage):
    (tmp_path / "a.npz").write_bytes(b"a")
    manifest = tmp_path / "manifest.json"
    add_to_manifest(manifest, tmp_path / "a.npz", command="python -m assets_gen body", config={}, licence="CC0")
    if damage == "absent":
        manifest.unlink()
    if damage == "broken":
        manifest.write_text(json.dumps({})[:1])
    if damage == "changed":
        (tmp_path / "a.npz").write_bytes(b"b")
    check = doctor.assets(tmp_path)
    assert check.well == (damage == "none")
    assert check.mend == ("" if damage == "none" else "python -m assets_gen all")
