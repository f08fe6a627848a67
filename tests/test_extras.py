"""A missing extra is one clear line; a fault inside an installed package is not taken for one."""

import re
import sys
import tomllib
from pathlib import Path

import pytest

from workbench.extras import EXTRAS, MissingExtra, require


def test_missing_extra_names_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "newton", None)  # import newton raises ModuleNotFoundError
    with pytest.raises(MissingExtra, match=r"run pip install -c constraints.txt -e '\.\[assets\]'") as missing:
        require("newton", extra="assets")
    assert "\n" not in str(missing.value)


def test_installed_module_is_returned():
    assert require("json.decoder", extra="lab") is sys.modules["json.decoder"]


def test_fault_inside_a_package_is_not_a_missing_extra(tmp_path, monkeypatch):
    (tmp_path / "broken_package.py").write_text("import a_module_that_nobody_has")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="a_module_that_nobody_has") as fault:
        require("broken_package", extra="lab")
    assert not isinstance(fault.value, MissingExtra)


def test_unknown_extra_is_told():
    with pytest.raises(ValueError, match=f"no extra 'gpu': pyproject.toml has {', '.join(EXTRAS)}$"):
        require("json", extra="gpu")


def test_extras_are_those_of_pyproject_and_every_package_is_pinned():
    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    assert set(EXTRAS) == set(project["optional-dependencies"])
    pins = dict(line.split("==") for line in (root / "constraints.txt").read_text().splitlines() if "==" in line)
    pinned = {normal(name) for name in pins}
    for requirement in [*project["dependencies"], *sum(project["optional-dependencies"].values(), [])]:
        name = normal(re.split(r"[\[<>=]", requirement)[0])
        assert name == normal(project["name"]) or name in pinned, f"{name} is not in constraints.txt"
    assert pins["torch"] == "2.13.0"
    assert not any("/" in line or "+" in line for line in pins)


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()
