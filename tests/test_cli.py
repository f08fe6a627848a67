"""The command line: status 0, 2 with exactly one line for unusable input, 1 with a traceback for a fault of ours."""

import json
import logging
import os
import subprocess
import sys
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import assets_gen.__main__ as assets_gen
from workbench import __version__, cli
from workbench.evaluation_table import at_most, told


@dataclass(frozen=True)
class FakeConfig:
    """A stage's config."""

    steps: int = 3
    fault: str = ""

    @staticmethod
    def paper_size() -> "FakeConfig":
        return FakeConfig(steps=1000, fault="")


FAULTS = {
    "ours": lambda: int_of_ours("x"),
    "theirs": lambda: np.zeros((2, 2)).reshape(7),
    "broken": lambda: {}["key"],
    "interrupt": lambda: (_ for _ in ()).throw(KeyboardInterrupt),
    "missing": lambda: __import__("newton"),
}


def int_of_ours(text):
    raise ValueError(f"steps {text!r} are no number:\n give some")


# An error counts as ours by the module that raises it.
int_of_ours = types.FunctionType(int_of_ours.__code__, {"__name__": "workbench.fake", "ValueError": ValueError})


@pytest.fixture
def fake_stage(monkeypatch):
    """A stage behind `workbench train fields` and `workbench evaluate fields`."""
    calls = []
    stage = types.ModuleType("fake_stage")

    def run(config):
        calls.append(config)
        if config.fault:
            FAULTS[config.fault]()

    def rows(config):
        run(config)
        return [at_most("error", 0.2, "mm", 0.3), at_most("tail", 9.0, "mm", 3.0), told("baseline", float("nan"), "mm")]

    stage.__dict__.update(FakeConfig=FakeConfig, run=run, rows=rows)
    monkeypatch.setitem(sys.modules, "fake_stage", stage)
    monkeypatch.setitem(cli.TRAININGS, "fields", ("fake_stage", "FakeConfig"))
    monkeypatch.setitem(cli.EVALUATIONS, "fields", ("fake_stage", "FakeConfig"))
    return calls


def refused(capsys, words, main=cli.main):
    """The one line on stderr with which a command refused its input."""
    assert main(words) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def test_help_answers_at_once_without_heavy_imports():
    code = (
        "import sys; from workbench.cli import main; status = main(['--help']);"
        "heavy = {'torch', 'numpy', 'scipy', 'warp', 'tyro', 'pyvista'} & set(sys.modules);"
        "sys.exit(f'heavy: {heavy}' if heavy else status)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in cli.COMMANDS:
        assert f"  {name} " in done.stdout


def test_version_and_module_entry():
    done = subprocess.run([sys.executable, "-m", "workbench", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, f"{__version__}\n")


def test_import_is_light_and_public_names_resolve():
    code = "import sys, workbench; sys.exit(bool({'torch', 'numpy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
    import workbench

    for name in workbench.__all__:
        assert getattr(workbench, name) is not None
        assert name in dir(workbench)
    with pytest.raises(AttributeError, match="workbench has no 'Bodyy'; it has Body, "):
        _ = workbench.Bodyy  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["fly"],
            "workbench: there is no command 'fly': workbench has "
            "demo, tryon, inspect, evaluate, train, fit, animate, export, doctor",
        ),
        (
            ["evaluate"],
            "workbench: workbench evaluate needs a NAME, one of "
            "fields, projection, subspace, collisions, runtime, points, views; got nothing",
        ),
        (
            ["train", "cats"],
            "workbench: workbench train needs a STAGE, one of fields, subspace, regressor, corrective, points; "
            "got 'cats'",
        ),
        (["doctor", "--fast"], "workbench: workbench doctor takes no options, got '--fast'"),
        (
            ["export", "absent.npz", "--out", "a.glb"],
            "workbench: no file at absent.npz; expected a dressed or simulated",
        ),
        (["export", "a.npz"], "workbench: Missing from workbench export: --out PATH"),
    ],
)
def test_unusable_words_are_refused_in_one_line(capsys, words, line):
    assert refused(capsys, words).startswith(line)


def test_options_reach_the_stage(fake_stage):
    assert cli.main(["train", "fields", "--steps", "7"]) == 0
    assert fake_stage == [FakeConfig(steps=7)]


def test_paper_gives_the_published_sizes_where_a_stage_has_them_and_options_still_count(fake_stage):
    assert cli.main(["train", "fields", "--paper"]) == 0
    assert cli.main(["train", "fields", "--steps", "9", "--paper"]) == 0
    assert fake_stage == [FakeConfig(steps=1000), FakeConfig(steps=9)]


def test_bad_options_are_refused_in_one_line(capsys, fake_stage):
    told_line = refused(capsys, ["train", "fields", "--steps", "many"])
    assert told_line.startswith("workbench: Error parsing --steps")
    assert told_line.endswith("(see workbench train fields --help)")
    assert "Unrecognized options: --stepz" in refused(capsys, ["train", "fields", "--stepz", "1"])
    assert fake_stage == []


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_refusal_is_one_line_on_any_terminal(tmp_path, encoding):
    done = subprocess.run(
        [sys.executable, "-m", "workbench", "export", "a.npz", "--out", "b", "--format", "fbx"],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONIOENCODING": encoding},
    )
    assert done.returncode == 2
    assert done.stderr.startswith("workbench: invalid choice 'fbx' for argument '--format'. Expected one of (")
    assert done.stderr.endswith(". (see workbench export --help)\n")
    assert done.stderr.count("\n") == 1


def test_help_of_a_command_ends_well(capsys, fake_stage):
    for words in (["train", "fields", "--help"], ["evaluate", "fields", "-h"], ["evaluate", "-h"], ["doctor", "-h"]):
        assert cli.main(words) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "--steps" in printed.out
    assert "--json" in printed.out
    assert fake_stage == []


def test_bad_value_found_by_a_stage_is_one_line(capsys, fake_stage):
    assert refused(capsys, ["train", "fields", "--fault", "ours"]) == "workbench: steps 'x' are no number: give some"


def test_missing_extra_is_one_line(capsys, fake_stage, monkeypatch):
    monkeypatch.setitem(sys.modules, "newton", None)
    line = refused(capsys, ["train", "fields", "--fault", "missing"])
    assert line.endswith("'newton', which is not installed: run pip install -c constraints.txt -e '.[assets]'")


@pytest.mark.parametrize("fault", ["theirs", "broken"])
def test_fault_of_ours_keeps_its_traceback(capsys, fake_stage, fault):
    assert cli.main(["train", "fields", "--fault", fault]) == 1
    assert "Traceback (most recent call last)" in capsys.readouterr().err


def test_interrupt_is_told(capsys, fake_stage):
    assert cli.main(["train", "fields", "--fault", "interrupt"]) == 130
    assert capsys.readouterr().err == "workbench: interrupted\n"


def test_evaluation_prints_its_table_and_writes_the_same_rows(capsys, tmp_path, fake_stage):
    path = tmp_path / "new" / "rows.json"
    assert cli.main(["evaluate", "fields", "--steps", "2", "--json", str(path)]) == 0
    assert fake_stage == [FakeConfig(steps=2)]
    printed = capsys.readouterr().out
    rows = json.loads(path.read_text())
    assert rows["name"] == "fields"
    assert [row["metric"] for row in rows["rows"]] == ["error", "tail", "baseline"]
    assert [row["holds"] for row in rows["rows"]] == [True, False, None]
    assert all(row["metric"] in printed for row in rows["rows"])


def test_warnings_go_to_stderr_and_progress_to_stdout(capsys, fake_stage):
    def log_both(words):
        logging.getLogger("workbench").info("working")
        logging.getLogger("workbench").warning("careful")
        return 0

    assert cli.ended(lambda: log_both([]), "workbench") == 0
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("working\n", "careful\n")


def test_the_picture_comes_from_outside():
    """workbench imports no drawing code: what draws is found by name."""
    draw = cli.plugged_in("workbench.pictures", "demo")
    assert draw is not None
    assert draw.__module__ == "widgets.demo_picture"
    assert cli.plugged_in("workbench.pictures", "absent") is None


def test_asset_maker_speaks_the_same_way(capsys):
    assert assets_gen.main([]) == 0
    assert "WHAT is one of: body, garments" in capsys.readouterr().out
    line = refused(capsys, ["cars"], main=assets_gen.main)
    assert line.startswith("python -m assets_gen: python -m assets_gen needs a WHAT, one of body, ")
    line = refused(capsys, ["body", "--adults", "few"], main=assets_gen.main)
    assert "Error parsing --adults" in line
    assert Path(assets_gen.__file__).name == "__main__.py"


def test_a_reader_that_has_seen_enough_ends_a_command_quietly():
    code = "from workbench.cli import main; import sys; sys.exit(main(['fit', '--help']))"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == cli.UNREAD
