"""The demos, found on disk."""

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DEMOS = sorted(path.stem for path in (ROOT / "demos").glob("*.py"))
