"""Options in place of the settings and arguments that texts of the library name."""

import argparse
import inspect
import re

import pytest
from conftest import ROOT

from uwblite.cli import VERBS, console
from uwblite.cli.options import OPTIONS, name_options, name_options_in
from uwblite.drivers.create2 import Create2Driver
from uwblite.drivers.devices import DEVICES
from uwblite.drivers.log_file import LogFile
from uwblite.drivers.odometry_line import GyroLineDriver, OdometryLineDriver
from uwblite.drivers.rplidar import RpLidarDriver
from uwblite.drivers.scip_driver import ScipDriver
from uwblite.evaluation.map import find_columns
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.findings import doubt
from uwblite.graph.robust import Kernel
from uwblite.io.formats import read_recording
from uwblite.localization.live_feed import Patience
from uwblite.navigation.planner import Planner, make_planner
from uwblite.radio.anchor_planning import plan_anchors
from uwblite.server.web import server_for


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("upside down (`mounting.laser_flipped`)?", "upside down (--laser-flipped)?"),
        ("yards (`range_unit=0.9144`)", "yards (`uwblite convert --range-unit=0.9144`)"),
        ("cut at `end=12`", "cut at `uwblite convert run.log before.log --end=12`"),
        ("`use_lidar=true`, `frame`, a ` alone", "`use_lidar=true`, `frame`, a ` alone"),
    ],
)  # fmt: skip
def test_names_become_options(said, shown):
    assert name_options(said) == shown


def test_what_is_printed_and_what_is_written_says_the_same(capsys):
    console.say("give `mounting.tag_position`")
    console.note("use `force`")
    console.fail("choose another `folder`", 1)
    out, err = capsys.readouterr()
    assert out == "give --tag\n"
    assert err == "use --force\nuwblite: error: choose another --out\n"
    (found,) = name_options_in([doubt("odd", "see `crop`")])
    assert (found.text, found.kind) == ("see --crop", "odd")
    assert console.plain({"text": "use `force`"}) == {"text": "use --force"}


def test_every_option_exists_and_every_name_is_said():
    known = set()
    for verb in VERBS.values():
        parser = argparse.ArgumentParser()
        verb.add_arguments(parser)
        known |= set(parser._option_string_actions)
    core = (f for f in (ROOT / "uwblite").rglob("*.py") if "cli" not in f.parts)
    texts = "".join(f.read_text(encoding="utf-8") for f in core)
    for name, option in OPTIONS.items():
        assert next(word for word in option.split() if word.startswith("--")) in known
        assert any(f"`{said}" in texts for said in (name, *COMPOSED.get(name, ()))), name


COMPOSED = {"start": ("{edge}=",), "end": ("{edge}=",), "laser_unit": ("{option}_unit=",), "odometry_unit": ("{option}_unit=",)}
"""How texts name what they put together from parts."""


def parser_of(verb):
    parser = argparse.ArgumentParser(exit_on_error=False, add_help=False)
    VERBS[verb].add_arguments(parser)
    for action in parser._actions:
        action.required = False
    return parser


@pytest.mark.parametrize("verb", VERBS)
def test_the_default_of_a_number_or_a_name_is_the_one_that_the_help_states(verb):
    for action in parser_of(verb)._actions:
        if isinstance(action.default, bool | list | None) or action.default in ("", *EXPLAINED):
            continue
        value = action.default if isinstance(action.default, str) else f"{action.default:g}"
        assert re.search(rf"\({re.escape(value)}[);]", action.help), f"{verb} {action.option_strings}: {value}"


EXPLAINED = ("refuse", "127.0.0.1", "none", 0)
"""Defaults that stand in other words: 0 is any port, and a log in one part."""


def test_a_page_without_an_address_is_for_this_computer_alone_and_port_8000():
    for verb, name in (("record", "--watch"), ("localize", "--serve")):
        read = parser_of(verb).parse_known_args
        dest = name.strip("-")
        assert [getattr(read(words)[0], dest) for words in ([], [name], [name, "81"], [name, "0.0.0.0:65535"])] == [
            None, ("127.0.0.1", 8000), ("127.0.0.1", 81), ("0.0.0.0", 65535),
        ]  # fmt: skip
    assert parser_of("watch").parse_known_args([])[0].host == "127.0.0.1"
    assert parser_of("optimize").parse_known_args([])[0].kernel == "none"
    assert parser_of("plan").parse_known_args([])[0].unknown == "refuse"
    assert parser_of("view").parse_known_args([])[0].port == parser_of("record").parse_known_args([])[0].rotate == 0


LIMITS = [
    ("view", "--port", ["0", "65535"], ["-1", "65536", "1.5"]),
    ("watch", "--port", ["0", "65535"], ["-1", "65536"]),
    ("record", "--watch", ["1", "65535"], ["0", "65536", "x", ":"]),
    ("plan", "--radius", ["0", "1000"], ["-0.001", "1000.1", "inf"]),
    ("plan", "--step", ["0.001"], ["0.0009", "nan"]),
    ("plan", "--from", ["1,2", "1,2,3", "-1e7,1e7"], ["1", "1,2,3,4", "1.1e7,0", "nan,0", "a,b"]),
    ("plan", "--to", ["1,2"], ["1", "1,2,3"]),
    ("plan-anchors", "--count", ["1"], ["0", "1.5"]),
    ("plan-anchors", "--reach", ["1e-9"], ["0"]),
    ("map", "--jobs", ["1"], ["0"]),
    ("map", "--every-nth-scan", ["1"], ["0"]),
    ("map", "--crop", ["1,2,3,4"], ["1,2,3", "1,2,3,4,5"]),
    ("map", "--tag", ["1,2,3"], ["1,2", "1,2,3,4"]),
    ("map", "--anchor-height", ["-1", "0"], ["inf", "x"]),
    ("record", "--rotate", ["0", "5"], ["5K", "5.5M", "-1", "5kM"]),
    ("record", "--sync", ["0"], ["-0.1"]),
    ("record", "--duration", ["0.1"], ["0"]),
    ("record", "--laser-flipped", ["1", "5"], ["0", "6"]),
    ("devices", "--pan-id", ["0x0001", "FFFF"], ["0", "10000", "-1", "x"]),
    ("localize", "--rate", ["0.1"], ["0"]),
    ("evaluate", "--recording", ["1"], ["0"]),
    ("convert", "--start", ["-5", "0"], ["inf"]),
    ("convert", "--time-unit", ["1e-9"], ["0", "-1"]),
    ("optimize", "--kernel-scale", ["0.1"], ["0"]),
]
"""Values of options at the edge of what is taken, and beyond it."""


@pytest.mark.parametrize(("verb", "name", "taken", "refused"), LIMITS)
def test_numbers_are_taken_up_to_their_limits(verb, name, taken, refused):
    parser = parser_of(verb)
    for value in taken:
        assert not parser.parse_known_args([f"{name}={value}"])[1]
    for value in refused:
        with pytest.raises(argparse.ArgumentError):
            parser.parse_known_args([f"{name}={value}"])


def test_sizes_have_decimal_prefixes_and_numbers_of_networks_are_hexadecimal():
    sizes = [parser_of("record").parse_known_args(["--rotate", text])[0].rotate for text in ("7", "7k", "7M", "7G")]
    assert sizes == [7, 7_000, 7_000_000, 7_000_000_000]
    assert [parser_of("devices").parse_known_args([f"--pan-id={text}"])[0].pan_id for text in ("0xC0DE", "ffff")] == [
        0xC0DE, 0xFFFF,
    ]  # fmt: skip


REPEATABLE = {
    "map": [("--without", "uwb", "lidar"), ("--set", "a=1", "b=2"), ("--uwb-topic", "/a", "/b")],
    "plan": [("--via", "1,2", "3,4")],
    "record": [("--uwb", "a", "b"), ("--lidar", "a", "b"), ("--odometry", "a", "b"), ("--gyro", "a", "b"),
               ("--laser-pose", "1,2,3", "4,5,6"), ("--tag", "1,2,3", "4,5,6"), ("--laser-flipped", "1", "2")],
    "localize": [("--uwb", "a", "b"), ("--lidar", "a", "b"), ("--odometry", "a", "b"), ("--gyro", "a", "b")],
    "convert": [("--recording", "a", "b")],
    "evaluate": [("--truth", "a", "b")],
    "optimize": [("--set", "a=1", "b=2")],
}  # fmt: skip


@pytest.mark.parametrize("verb", REPEATABLE)
def test_what_may_be_given_twice_keeps_both_in_their_order(verb):
    for name, first, second in REPEATABLE[verb]:
        args, _ = parser_of(verb).parse_known_args([f"{name}={first}", f"{name}={second}"])
        both = getattr(args, name.strip("-").replace("-", "_"))
        alone = [getattr(parser_of(verb).parse_known_args([f"{name}={one}"])[0], name.strip("-").replace("-", "_"))
                 for one in (first, second)]  # fmt: skip
        assert both == [*alone[0], *alone[1]]
        assert len(both) == 2


OF_FUNCTIONS = [
    ("evaluate", "max_gap", evaluate_trajectory, "max_gap"),
    ("evaluate", "delta", evaluate_trajectory, "rpe_delta"),
    ("evaluate", "search_radius", find_columns, "search_radius"),
    ("plan", "step", Planner.plan, "step"),
    ("plan", "unknown", make_planner, "unknown"),
    ("plan-anchors", "reach", plan_anchors, "reach"),
    ("localize", "late", Patience, "late"),
    ("localize", "lost_after", Patience, "lost"),
    ("optimize", "kernel", Kernel, "name"),
    ("view", "port", server_for, "port"),
    ("watch", "host", server_for, "host"),
    ("record", "sync", LogFile, "sync"),
    ("record", "rotate", LogFile, "rotate"),
    ("map", "every_nth_scan", read_recording, "every_nth_scan"),
]


@pytest.mark.parametrize(("verb", "name", "function", "argument"), OF_FUNCTIONS)
def test_what_is_not_given_is_the_same_on_the_command_line_and_in_the_library(verb, name, function, argument):
    default = inspect.signature(function).parameters[argument].default
    assert parser_of(verb).parse_known_args([])[0].__dict__[name] == default


@pytest.mark.parametrize(
    ("name", "driver"),
    [("line", OdometryLineDriver), ("gyro-line", GyroLineDriver), ("create2", Create2Driver), ("scip", ScipDriver),
     ("rplidar", RpLidarDriver)],
)  # fmt: skip
def test_a_driver_that_is_made_without_a_speed_has_that_of_its_option(name, driver):
    assert inspect.signature(driver).parameters["baud"].default == DEVICES[name].options["baud"].default
