"""The console script `bitymi`. What it takes a second to import is imported where Ctrl-C is already met."""

import sys


def main() -> int:
    """Run one command; returns its exit status."""
    try:
        from bitymi_ns import endings
    except KeyboardInterrupt:
        return 130

    def command() -> int:
        from bitymi_ns import cli

        return cli.main()

    return endings.run(command)


if __name__ == "__main__":
    sys.exit(main())
