"""`uwblite config`: print the settings of the mapper as commented TOML."""

import argparse

from ..config import to_toml
from . import console
from .inputs import effective_config


def run(args: argparse.Namespace) -> int:
    config = effective_config(args)
    header = f"uwblite settings{f', preset {args.preset}' if args.preset else ''}; use with: uwblite map LOG --config FILE"
    console.say_lines(to_toml(config, comments=not args.no_comments, header=header, advanced=args.all).rstrip("\n"))
    return 0
