"""Curves of a training: (step, name, value) -> a JSON-lines file that a resumed run continues, and TensorBoard."""

import json
import logging
import re
from collections.abc import Mapping
from pathlib import Path

log = logging.getLogger(__name__)


class ScalarLog:
    """Numbers by step, kept in `folder/curves.jsonl`; also for TensorBoard where tensorboardX is installed.

    A run that continues at step `begin` drops what a killed one wrote from there on.
    """

    def __init__(self, folder: Path, *, begin: int = 0):
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / "curves.jsonl"
        kept = [entry for entry in read_curves(self.path) if entry["step"] < begin]
        self.path.write_text("".join(json.dumps(entry) + "\n" for entry in kept), encoding="utf-8")
        self.writer = _tensorboard(folder)

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Append what was measured after `step` steps."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"step": step, **values}) + "\n")
        if self.writer is not None:
            for name, value in values.items():
                self.writer.add_scalar(re.sub(r"[^\w./-]+", "_", name), value, step)
            self.writer.flush()


def read_curves(path: Path) -> list[dict[str, int | float]]:
    """The entries of a curves file, oldest first; a last line that was cut by a kill is left out."""
    if not path.is_file():
        return []
    entries = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            entries.append(json.loads(line))
        except json.JSONDecodeError:
            log.warning("%s: a line that is cut was left out", path)
    return entries


def _tensorboard(folder: Path):
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        log.info("no tensorboardX: curves go to %s only (pip install tensorboardX for TensorBoard)", folder)
        return None
    return SummaryWriter(str(folder))
