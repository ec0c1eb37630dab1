"""``python -m daq.cli``, the same as ``rig``."""

from daq.cli import main

main()
