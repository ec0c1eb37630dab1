"""``python -m daq``, the same as ``rig``."""

from daq.cli import main

main()
