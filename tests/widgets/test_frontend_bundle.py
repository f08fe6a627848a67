"""The browser's code: is there, is made of these sources, and its absence names the command that makes it."""

import importlib.util

import numpy as np
import pytest

from widgets import frontend_bundle, live, page
from widgets.frontend_bundle import BUNDLE_COMMAND, STATIC, NotBundled, bundled
from widgets.scene import Points, Scene, View


@pytest.fixture
def unbundled(tmp_path, monkeypatch):
    """A package that was built without Node."""
    monkeypatch.setattr(frontend_bundle, "STATIC", tmp_path / "static")
    bundled.cache_clear()
    yield
    bundled.cache_clear()


@pytest.fixture
def scene():
    return Scene((View((Points(np.eye(3)),)),))


def test_a_missing_bundle_names_the_command(unbundled):
    with pytest.raises(NotBundled, match=f"run {BUNDLE_COMMAND} in the checkout, with network access"):
        bundled("view.js")


def test_live_view_and_page_say_the_same(unbundled, scene, tmp_path):
    with pytest.raises(NotBundled, match=BUNDLE_COMMAND):
        live.LiveScene(scene)
    with pytest.raises(NotBundled, match=BUNDLE_COMMAND):
        page.write_page(tmp_path / "a.html", scene)
    assert not (tmp_path / "a.html").exists()


def test_the_bundle_is_of_these_sources():
    """Whoever changes frontend/src and forgets to bundle would test yesterday's code."""
    spec = importlib.util.spec_from_file_location("bundle", STATIC.parent / "frontend" / "bundle.py")
    assert spec is not None
    assert spec.loader is not None
    bundler = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(bundler)
    assert (STATIC / "made_of.txt").read_text() == bundler._source_hash(), f"run {BUNDLE_COMMAND}"
