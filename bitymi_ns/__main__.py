"""The console script `bitymi`. Slow imports happen where Ctrl-C is already handled."""

import sys
import warnings


def main() -> int:
    try:
        from . import exit_messages
    except KeyboardInterrupt:
        return 130

    # from nerfstudio's use of torch
    warnings.filterwarnings("ignore", category=FutureWarning, module="nerfstudio")

    def command() -> int:
        from . import cli

        return cli.main()

    return exit_messages.run(command)


if __name__ == "__main__":
    sys.exit(main())
