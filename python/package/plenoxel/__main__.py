"""The program ``plenoxel``, as ``python -m plenoxel``."""

import signal
import sys

from . import _plenoxel


def main() -> int:
    """Run the program with the arguments of the process, and return its exit code."""
    # The program handles interruptions itself.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return _plenoxel.program(["plenoxel", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())
