"""Optional packages: a module and the extra that brings it -> the module, or one line that says what to install."""

import importlib
from types import ModuleType

# What each extra of pyproject.toml is for, by the modules that stand for it.
EXTRAS = {
    "assets": ("newton", "anny", "dask", "distributed", "networkx"),
    "meshing": ("open3d",),
    "runtime": ("onnx", "onnxruntime"),
    "train": ("tensorboardX",),
    "lab": ("jupyterlab", "ipywidgets", "anywidget", "matplotlib"),
    "test": ("pytest", "xdist", "hypothesis", "beartype", "nbmake"),
}


class MissingExtra(ImportError):
    """An optional package is not installed; the message names the one command that installs it."""


def install_command(extra: str) -> str:
    """From a checkout: the package is not on an index."""
    return f"pip install -c constraints.txt -e '.[{extra}]'"


def missing_extra(error: ImportError) -> MissingExtra | None:
    """The missing extra behind a failed import, or None when it is something else that failed."""
    if isinstance(error, MissingExtra):
        return error
    package = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError):
        return None
    for extra, modules in EXTRAS.items():
        if package in modules:
            return _missing(package, extra)
    return None


def _missing(package: str, extra: str) -> MissingExtra:
    return MissingExtra(
        f"this needs the package {package!r}, which is not installed: run {install_command(extra)}", name=package
    )


def require(module: str, extra: str) -> ModuleType:
    """Import `module`, which the extra `extra` brings.

    Raises MissingExtra when the package itself is absent.  An error inside an installed package is left as it is:
    it is not the user's missing extra.
    """
    if extra not in EXTRAS:
        raise ValueError(f"there is no extra {extra!r}: pyproject.toml has {', '.join(EXTRAS)}")
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        package = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != package:
            raise
        raise _missing(package, extra) from error
