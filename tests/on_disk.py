"""The demos, found on disk."""

import importlib.util
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DEMOS = sorted(path.stem for path in (ROOT / "demos").glob("*.py"))


def load_demo(name):
    """Module of a demo, by its name."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "demos" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
