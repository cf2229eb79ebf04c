"""Folders that tests use."""

from pathlib import Path

TEST = Path(__file__).resolve().parent
ROOT = TEST.parent
BAGS = ROOT / 'bags'
SHARE = ROOT / 'boxreg_ros' / 'share'
SHARED = ROOT.parent / 'shared'
"""Data that is not part of the project; tests that need it are skipped without it."""
