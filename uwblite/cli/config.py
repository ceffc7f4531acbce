"""`uwblite config`: print the settings of the mapper as commented TOML."""

import argparse

HELP = "print the settings with their meaning, as a file for --config"
EPILOG = """\
examples:
  uwblite config > my.toml                      the settings, each with unit, meaning and default
  uwblite config --all                          also those for experiments
  uwblite config --preset paper                 the settings of a preset
  uwblite config --set icp.max_iterations=30    try a change: names and ranges are checked
  uwblite config --config my.toml               check a file and show the effective settings
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    from .options import add_settings_arguments

    add_settings_arguments(parser)
    parser.add_argument("--all", action="store_true", help="list settings for experiments too")
    parser.add_argument("--no-comments", action="store_true", help="values only")


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    from ..io.settings_toml import to_toml
    from . import console
    from .options import effective_config

    config = effective_config(args)
    header = f"uwblite settings{f', preset {args.preset}' if args.preset else ''}; use with: uwblite map LOG --config FILE"
    console.say_lines(to_toml(config, comments=not args.no_comments, header=header, advanced=args.all).rstrip("\n"))
    return 0
