"""``python test/measure NAME [OPTION]...``."""

from pathlib import Path
import sys

TEST = Path(__file__).resolve().parents[1]
sys.path[:1] = [str(TEST), str(TEST.parent / 'docs')]  # of this package, and of the tables

from measure import main  # noqa: E402

sys.exit(main(sys.argv[1:]))
