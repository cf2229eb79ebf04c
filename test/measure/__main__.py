"""``python test/measure NAME [OPTION]...``."""

from pathlib import Path
import sys

sys.path[0] = str(Path(__file__).resolve().parents[1])  # modules here import each other by package

from measure import main  # noqa: E402

sys.exit(main(sys.argv[1:]))
