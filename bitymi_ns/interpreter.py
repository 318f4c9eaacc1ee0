"""Python processes beside this one."""

import sys

_CODE = "import sys; sys.path[:] = [folder for folder in sys.path if folder]; from {0} import {1}; sys.exit({1}())"


def command(module: str, function: str) -> list[str]:
    """The command that calls a function of a module by this Python, without arguments; what the function returns is the
    exit code, as of a console script. Further words of the command are in `sys.argv`.

    The current folder is not on its search path, as it would be with `-m` or `-c` alone: it may be a capture of
    somebody else, and a `json.py` in it would be run. `-P` does the same, but Python 3.10 does not know it; `-I` does
    more, so that packages of the user's own would not be found.
    """
    return [sys.executable, "-c", _CODE.format(module, function)]
