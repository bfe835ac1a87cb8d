"""``hat config``: what a preset or file says, and what differs between two."""

from __future__ import annotations

import argparse

from hat_ros.cli.options import Commands, add_overrides

# Repeated here for a light start of every other command.
LEVELS = ("basic", "paper", "expert")


def add_commands(commands: Commands) -> None:
    """Register this group."""
    parser = commands.add_parser(
        "config",
        help="show a configuration, or what differs between two",
        description="Look at presets and configuration files. What `show` prints is YAML with comments: kept in a "
        "file, it is a configuration of your own.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    _add_show(actions)
    _add_diff(actions)


def _add_show(actions: Commands) -> None:
    parser = actions.add_parser(
        "show",
        help="print a preset or file as commented YAML",
        description="Print a configuration as YAML, each key with its meaning, its unit and the paper's symbol: what "
        "differs from the default preset, or, where nothing does, the basic keys. Complete with --all.",
    )
    parser.add_argument(
        "config", nargs="?", default="default", metavar="NAME|FILE", help="preset or YAML file (default: default)"
    )
    add_overrides(parser)
    extent = parser.add_mutually_exclusive_group()
    extent.add_argument("--all", action="store_true", help="every key")
    extent.add_argument(
        "--level",
        choices=LEVELS,
        help="the keys of one level. basic: what a user sets; paper: what a publication sets; expert: tuned constants",
    )
    parser.set_defaults(command=_show)


def _add_diff(actions: Commands) -> None:
    parser = actions.add_parser(
        "diff",
        help="what differs between two presets or files",
        description="Print one line per key that differs, `key: value in A -> value in B`; nothing if all are equal. "
        "The exit code is 0 in both cases.",
    )
    parser.add_argument("first", metavar="A", help="preset or YAML file, for instance the config.yaml of a run")
    parser.add_argument("second", metavar="B", help="preset or YAML file")
    parser.set_defaults(command=_diff)


def _show(arguments: argparse.Namespace) -> int:
    from hat_ros.config import HatConfig, commented_yaml, differences, flat_options, load_config

    config = load_config(arguments.config, arguments.overrides)
    levels = {key: item.metadata["level"] for key, (_, item) in flat_options().items()}
    keys = list(differences(HatConfig(), config))
    title = "what differs from the default preset; --all prints every key"
    if arguments.all:
        keys, title = list(levels), "every key"
    elif arguments.level or not keys:
        level = arguments.level or "basic"
        keys, title = [key for key in levels if levels[key] == level], f"the keys of the level {level}"
        title += "" if arguments.level else "; all are as in the default preset; --all prints every key"
    source = " --set ".join([arguments.config, *arguments.overrides])
    print(f"# {' '.join(source.split())}: {title}\n\n{commented_yaml(config, keys)}", end="")
    return 0


def _diff(arguments: argparse.Namespace) -> int:
    from hat_ros.config import differences, load_config, value_text

    found = differences(load_config(arguments.first), load_config(arguments.second))
    for key, (first, second) in found.items():
        print(f"{key}: {value_text(first)} -> {value_text(second)}")
    return 0
