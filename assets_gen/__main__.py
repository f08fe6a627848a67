"""python -m assets_gen WHAT: regenerates what ships.  WHAT, its config -> files in workbench/assets, the manifest."""

import importlib
import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import replace

from workbench.cli import DONE, choice, ended, parsed, say

PROGRAM = "python -m assets_gen"
ALL = "all"

# In the order in which each needs the ones before.
MAKERS = {
    "body": ("assets_gen.body", "BodyConfig"),
    "garments": ("assets_gen.garments", "GarmentsConfig"),
    "motions": ("assets_gen.motions", "MotionsConfig"),
    "checkpoints": ("assets_gen.checkpoints", "CheckpointsConfig"),
    "simulations": ("assets_gen.simulations", "SimulationsConfig"),
    "scans": ("assets_gen.scans", "ScansConfig"),
    "dataset": ("assets_gen.dataset", "DatasetConfig"),
    "outfits": ("assets_gen.outfit_dataset", "OutfitsConfig"),
    "models": ("assets_gen.models", "ModelsConfig"),
    "points": ("assets_gen.point_models", "PointModelsConfig"),
}


def main(words: Sequence[str] | None = None) -> int:
    """Make one kind of asset, or all; returns the exit status (as `workbench`)."""
    return ended(lambda: _make(list(sys.argv[1:] if words is None else words)), PROGRAM)


def _make(words: list[str]) -> int:
    what, rest = choice(PROGRAM, "WHAT", {**MAKERS, ALL: None}, words or ["--help"])
    for name in MAKERS if what == ALL else [what]:
        module_name, config_name = MAKERS[name]
        module = importlib.import_module(module_name)
        config = parsed(getattr(module, config_name), f"{PROGRAM} {name}", rest)
        if what == ALL:
            say(f"== {name}")
            config = replace(config, ship=True) if hasattr(config, "ship") else config
        module.run(config)
    return DONE


if __name__ == "__main__":
    sys.exit(main())
