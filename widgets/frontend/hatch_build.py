"""Build hook of hatch: the browser bundles are made with the package, for a wheel and for an editable install alike.

Where Node or npm is out of reach, an editable install goes on without them (views then fall back to pictures and say
so); a wheel, which would carry the lack to others, is refused.
"""

import importlib.util
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class FrontendHook(BuildHookInterface):
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        spec = importlib.util.spec_from_file_location("bundle", Path(__file__).with_name("bundle.py"))
        assert spec is not None
        assert spec.loader is not None
        bundler = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(bundler)
        try:
            bundler.bundle()
        except bundler.CannotBundle as reason:
            if version != "editable":
                raise SystemExit(f"no wheel without the browser views: {reason}") from None
            self.app.display_warning(f"views will be pictures, not interactive: {reason}")
