"""`workbench COMMAND`: words -> a stage's config -> its result.  Status 0, 2 (unusable input, one line), 1 (our fault).

Each command imports its stage only when it is called, so that `workbench --help` answers at once.
"""

import contextlib
import dataclasses
import importlib
import importlib.metadata
import io
import itertools
import logging
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

from workbench import __version__
from workbench.extras import missing_extra

DONE, INTERNAL, UNUSABLE, INTERRUPTED, UNREAD = 0, 1, 2, 130, 141  # the last two as a shell says it: 128 + signal
OURS = ("workbench", "widgets", "assets_gen")

# `workbench evaluate NAME`: where its config class and its `rows(config)` are
EVALUATIONS = {
    "fields": ("workbench.collisions.field_evaluation", "FieldEvaluation"),
    "projection": ("workbench.collisions.projection_evaluation", "ProjectionEvaluation"),
    "subspace": ("workbench.collisions.subspace_evaluation", "SubspaceEvaluation"),
    "collisions": ("workbench.collisions.collision_evaluation", "CollisionEvaluation"),
    "runtime": ("workbench.collisions.runtime_evaluation", "RuntimeEvaluation"),
    "points": ("workbench.points.points_evaluation", "PointsEvaluation"),
}
# `workbench train STAGE`: where its config class and its `run(config)` are
TRAININGS = {
    "fields": ("workbench.collisions.field_training", "TrainFieldsConfig"),
    "subspace": ("workbench.collisions.subspace", "TrainSubspaceConfig"),
    "regressor": ("workbench.collisions.regressor", "TrainRegressorConfig"),
    "corrective": ("workbench.collisions.posed_corrective", "TrainCorrectiveConfig"),
    "points": ("workbench.points.training_run", "TrainPointsConfig"),
}


class Unusable(Exception):
    """Words on the command line that cannot be used; its text is one line."""


def main(words: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    words = list(sys.argv[1:] if words is None else words)
    return ended(lambda: _dispatch(words), "workbench")


def ended(command: Callable[[], int], program: str) -> int:
    """Run `command` and turn however it ends into an exit status and what stderr says."""
    _log_to_output()
    try:
        status = _helped(command)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # `| head` has seen enough; the interpreter would say so again when it flushes
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREAD
    except KeyboardInterrupt:
        sys.stderr.write(f"{program}: interrupted\n")
        return INTERRUPTED
    except Exception as error:  # noqa: BLE001  the outermost border: unusable input ends in a line, our faults in a traceback
        if is_unusable_input(error):
            sys.stderr.write(f"{program}: {_one_line(error)}\n")
            return UNUSABLE
        traceback.print_exc()
        return INTERNAL


def _helped(command: Callable[[], int]) -> int:
    try:
        return command()
    except Helped:
        return DONE


def is_unusable_input(error: BaseException) -> bool:
    """A file that cannot be opened, an extra that is missing, or a ValueError that our own code raised.

    A ValueError from inside a library is a fault of ours: it should have been checked at the border.
    """
    if isinstance(error, Unusable | FileNotFoundError | NotADirectoryError | IsADirectoryError | PermissionError):
        return True
    if isinstance(error, ImportError):
        return missing_extra(error) is not None
    if not isinstance(error, ValueError):
        return False
    frames = list(traceback.walk_tb(error.__traceback__))
    return bool(frames) and frames[-1][0].f_globals.get("__name__", "").partition(".")[0] in OURS


# --- commands


def demo(words: list[str]) -> int:
    from workbench.tryon_demo import TryOnDemoConfig, run

    config = parsed(TryOnDemoConfig, "workbench demo", words)
    run(config, picture=plugged_in("workbench.pictures", "tryon"), page=plugged_in("workbench.pages", "tryon"))
    say(f"written: {', '.join(str(path) for path in sorted(config.out.glob('*')))}")
    return DONE


def tryon(words: list[str]) -> int:
    from workbench.collisions.tryon import TryOnConfig, run

    config = parsed(TryOnConfig, "workbench tryon", words)
    result = run(config)
    say(f"written: {config.out} ({len(result.latent)} frames of {result.garment.shape[1]} vertices)")
    return DONE


def inspect(words: list[str]) -> int:
    from workbench.inspector import InspectConfig, run

    config = parsed(InspectConfig, "workbench inspect", words)
    run(config, page=plugged_in("workbench.pages", "inspect"))
    say(f"written: {', '.join(str(config.out / name) for name in ('report.json', 'report.html'))}")
    return DONE


def evaluate(words: list[str]) -> int:
    known = EVALUATIONS | registered_evaluations()
    name, rest = choice("workbench evaluate", "NAME", known, words)
    module_name, config_name = known[name]
    module = importlib.import_module(module_name)
    from workbench.evaluation_table import format_table, write_json

    options = parsed(_with_json(getattr(module, config_name)), f"workbench evaluate {name}", rest)
    rows = module.rows(options.config)
    say(format_table(rows))
    if options.json is not None:
        write_json(options.json, name, rows)
    return DONE


def train(words: list[str]) -> int:
    stage, rest = choice("workbench train", "STAGE", TRAININGS, words)
    module_name, config_name = TRAININGS[stage]
    module = importlib.import_module(module_name)
    config_type, default = getattr(module, config_name), None
    if "--paper" in rest and hasattr(config_type, "paper_size"):
        rest, default = [word for word in rest if word != "--paper"], config_type.paper_size()
    module.run(parsed(config_type, f"workbench train {stage}", rest, default))
    return DONE


def fit(words: list[str]) -> int:
    from workbench.points.fit_command import FitScanConfig, run

    config = parsed(FitScanConfig, "workbench fit", words)
    run(config)
    say(f"written: {config.out}; next: workbench animate {config.out} --motion FILE --out DIR")
    return DONE


def animate(words: list[str]) -> int:
    from workbench.points.animate_command import AnimateConfig, run

    written = run(parsed(AnimateConfig, "workbench animate", words))
    say(f"written: {', '.join(map(str, written))}")
    return DONE


def export(words: list[str]) -> int:
    from workbench.export import ExportConfig, run

    written = run(parsed(ExportConfig, "workbench export", words))
    say(f"written: {', '.join(map(str, written))}")
    return DONE


def doctor(words: list[str]) -> int:
    from workbench import doctor as machine

    if words and words[0] in ("-h", "--help"):
        say("usage: workbench doctor\n\nWhat this machine has and lacks, with the one command that mends it.")
        return DONE
    if words:
        raise Unusable(f"workbench doctor takes no options, got {' '.join(words)!r}")
    say(machine.report(machine.run()))
    return DONE


@dataclasses.dataclass(frozen=True)
class Command:
    """A command: its function and the line that tells what it does."""

    run: Callable[[list[str]], int]
    arguments: str
    does: str


COMMANDS = {
    "demo": Command(demo, "[--out DIR]", "dress a body and a motion that no training saw: .html, .glb, .png, report"),
    "tryon": Command(
        tryon, "GARMENT --motion FILE --out FILE.npz", "dress a body in a garment through any motion file"
    ),
    "inspect": Command(
        inspect, "BODY [GARMENT] --out DIR", "collisions of any mesh sequences: when, where, how deep; .json and .html"
    ),
    "evaluate": Command(
        evaluate, f"{'|'.join(EVALUATIONS)} [--json FILE]", "the figures of a stage, with their bounds"
    ),
    "train": Command(train, "|".join(TRAININGS), "train a stage; a run that was ended continues"),
    "fit": Command(fit, "SCAN --out DIR", "fit the points model to a scan of an outfit that no training saw"),
    "animate": Command(animate, "FIT --motion FILE --out DIR", "the fitted outfit through any motion, as points"),
    "export": Command(export, "SEQUENCE.npz --out PATH", "a sequence as .glb, .npz, OBJ, PLY or PC2"),
    "doctor": Command(doctor, "", "what this machine has and lacks, with the command that mends it"),
}


def usage() -> str:
    width = max(len(f"{name} {command.arguments}") for name, command in COMMANDS.items())
    lines = [f"  {f'{name} {command.arguments}':<{width}}  {command.does}" for name, command in COMMANDS.items()]
    return "\n".join(
        ["usage: workbench COMMAND [OPTIONS]", "", *lines, "", "workbench COMMAND --help explains each; --version."]
    )


def plugged_in(group: str, name: str) -> Callable[..., Any] | None:
    """What another package registered under an entry point: workbench computes, and who draws comes from outside."""
    for entry in importlib.metadata.entry_points(group=group, name=name):
        return entry.load()
    return None


def registered_evaluations() -> dict[str, tuple[str, str]]:
    """As EVALUATIONS, of what draws: `views`."""
    registered = importlib.metadata.entry_points(group="workbench.evaluations")
    return {entry.name: (entry.module, entry.attr) for entry in registered}


# --- words


def parsed(config_type: Any, program: str, words: Sequence[str], default: Any = None) -> Any:
    """A config from words, by tyro; what they do not say is as in `default`, or the type's own defaults.

    Raises Unusable with one line where tyro would draw a box.
    """
    import tyro

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            start = {} if default is None else {"default": default}
            return tyro.cli(config_type, prog=program, args=list(words), **start)
    except SystemExit as end:
        if not end.code:
            raise Helped from end
        raise Unusable(f"{_unboxed(complaint.getvalue())} (see {program} --help)") from end


class Helped(Exception):
    """The help that was asked for has been printed."""


def _unboxed(box: str) -> str:
    """The words of tyro's box, below its title and up to its first rule; how it is drawn varies with the terminal."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", box)
    _, *lines = [line.strip("│╭╮╰╯ ") for line in plain.splitlines()] or [""]
    words = itertools.dropwhile(_is_rule, lines)
    return " ".join(itertools.takewhile(lambda line: not _is_rule(line), words)) or "the options cannot be used"


def _is_rule(line: str) -> bool:
    return not line.strip("─- ")


def _with_json(config_type: Any) -> Any:
    """The stage's own config, and `--json FILE` beside it."""
    import tyro

    json = Annotated[Path | None, tyro.conf.arg(help="Write the rows to this file, too.")]
    config = tyro.conf.OmitArgPrefixes[config_type]
    made = dataclasses.make_dataclass("Evaluate", [("config", config), ("json", json, None)], frozen=True)
    made.__doc__ = config_type.__doc__
    return made


def choice(program: str, label: str, choices: dict[str, Any], words: list[str]) -> tuple[str, list[str]]:
    if words and words[0] in choices:
        return words[0], words[1:]
    if words and words[0] in ("-h", "--help"):
        say(f"usage: {program} {label} [OPTIONS]\n\n{label} is one of: {', '.join(choices)}")
        raise Helped
    got = repr(words[0]) if words else "nothing"
    raise Unusable(f"{program} needs a {label}, one of {', '.join(choices)}; got {got}")


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        say(usage())
        return DONE
    if words[0] == "--version":
        say(__version__)
        return DONE
    if words[0] not in COMMANDS:
        raise Unusable(f"there is no command {words[0]!r}: workbench has {', '.join(COMMANDS)}")
    return COMMANDS[words[0]].run(words[1:])


# --- what is said, and where


def say(text: str) -> None:
    sys.stdout.write(text + "\n")


def _one_line(error: BaseException) -> str:
    if isinstance(error, ImportError):
        error = missing_extra(error) or error
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.strerror}: {error.filename}"
    return " ".join(str(error).split()) or type(error).__name__


def _log_to_output() -> None:
    """What is being done goes to the output, warnings to stderr, which stays clean otherwise."""
    told, warned = logging.StreamHandler(sys.stdout), logging.StreamHandler(sys.stderr)
    told.addFilter(lambda record: record.levelno < logging.WARNING)
    warned.setLevel(logging.WARNING)
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[told, warned], force=True)


if __name__ == "__main__":
    sys.exit(main())
