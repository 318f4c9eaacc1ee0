"""The console script `bitymi`. What it takes a second to import is imported where Ctrl-C is already met."""

import sys
import warnings


def main() -> int:
    """Run one command; returns its exit status."""
    try:
        from bitymi_ns import endings
    except KeyboardInterrupt:
        return 130

    # of nerfstudio's use of torch, about which no user can do anything
    warnings.filterwarnings("ignore", category=FutureWarning, module="nerfstudio")

    def command() -> int:
        from bitymi_ns import cli

        return cli.main()

    return endings.run(command)


if __name__ == "__main__":
    sys.exit(main())
