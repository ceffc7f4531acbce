"""What the command line says is what is done, written down and said again."""

import argparse
import shlex
from types import SimpleNamespace

import pytest

from uwblite.cli import _parser_of, record
from uwblite.cli.making import repeat_command
from uwblite.cli.options import numbers
from uwblite.cli.verbs import VERBS, _pan_id, _size
from uwblite.pipeline.mapping_config import MappingConfig

MAP = _parser_of("map", VERBS["map"])
STATED = [
    ["--every-nth-scan", "3"], ["--odometry-topic", "/odom2"], ["--scan-topic", "/back"], ["--imu-topic", "/imu"],
    ["--base-frame", "base"], ["--uwb-topic", "/a", "--uwb-topic", "/b c"], ["--uwb-mapping", "tags.toml"], ["--scale-map"],
    ["--constraints", "known.toml"], ["--anchors-from", "before"], ["--laser-flipped"], ["--anchor-height", "1.5"],
    ["--laser-pose=-0.1,0,3.1"], ["--tag=0.1,0.2,0.3"], ["--preset", "paper"],
]  # fmt: skip
"""Options that change a map, each as its user gives it."""


@pytest.mark.parametrize("words", [[], *STATED, [word for words in STATED for word in words]])
def test_the_command_that_makes_a_map_again_means_the_same(words):
    args = MAP.parse_args(["run.log", "other.log", "--out", "map", *words])
    again = MAP.parse_args(shlex.split(repeat_command(args, MappingConfig()))[2:])
    given, said = (dict(vars(each)) for each in (args, again))
    assert said.pop("out") == "map_again"
    given.pop("out"), given.pop("set"), said.pop("set")
    assert said == given


def test_files_of_the_command_stand_with_their_names_alone():
    words = ["/data/run.log", "--out", "x", "--constraints", "/home/me/known.toml", "--uwb-mapping", "/etc/tags.toml"]
    command = repeat_command(MAP.parse_args(words), MappingConfig())
    assert command == "uwblite map run.log --constraints known.toml --uwb-mapping=tags.toml --out map_again"


@pytest.mark.parametrize(("text", "size"), [("60k", 60_000), ("500M", 500_000_000), ("2G", 2_000_000_000), ("17", 17)])
def test_sizes_have_decimal_units(text, size):
    assert _size(text) == size


@pytest.mark.parametrize("text", ["", "k", "1.5M", "-3", "5T", "5 M"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="is not a size such as 500M"):
        _size(text)


def test_network_ids_are_hexadecimal_and_of_16_bits():
    assert (_pan_id("0xC0DE"), _pan_id("1"), _pan_id("ffff")) == (0xC0DE, 1, 0xFFFF)
    for text in ("0", "10000", "-1", "g", ""):
        with pytest.raises(argparse.ArgumentTypeError, match="is not a network id"):
            _pan_id(text)


def test_so_many_numbers_are_wanted_and_no_others():
    assert numbers(3)("1,-2,0.5") == (1.0, -2.0, 0.5)
    assert [numbers(2, 3)(text) for text in ("1,2", "1,2,3")] == [(1.0, 2.0), (1.0, 2.0, 3.0)]
    wrong = ((numbers(3), "1,2"), (numbers(2, 3), "1,2,3,4"), (numbers(2), "a,b"), (numbers(1), "1e300"), (numbers(1), "nan"))
    for read, text in wrong:
        with pytest.raises(argparse.ArgumentTypeError, match="numbers separated by commas"):
            read(text)


def test_a_recording_states_the_mounting_that_its_command_gave():
    words = ["--out", "x.log", "--tag", "0.1,0.2,0.3", "--tag", "1,2,3", "--anchor-height", "1.5", "--laser-flipped", "2"]
    args = _parser_of("record", VERBS["record"]).parse_args(words)
    assert record.mounting_params(args, 12.5) == [
        ("host_monotonic_zero", "12.500000"),
        ("uwb_tag_offset_x", "0.100000"), ("uwb_tag_offset_y", "0.200000"), ("uwb_tag_height", "0.300000"),
        ("uwb2_tag_offset_x", "1.000000"), ("uwb2_tag_offset_y", "2.000000"), ("uwb2_tag_height", "3.000000"),
        ("uwb_anchor_height", "1.500000"), ("laser2_flipped", "on"),
    ]  # fmt: skip
    none = _parser_of("record", VERBS["record"]).parse_args(["--out", "x.log"])
    assert record.mounting_params(none, 0.0) == [("host_monotonic_zero", "0.000000")]


def link(name, rate, *, port="open", quiet=False, anchors=(), lost=0, corrupt=()):
    counts = SimpleNamespace(anchors=anchors, lost=lost, corrupt=dict(corrupt))
    return SimpleNamespace(name=name, rate=rate, port=port, quiet=quiet, counts=counts, url=f"/dev/{name}")


def test_the_line_of_state_names_every_device_and_what_it_lost():
    links = [
        link("lidar", 10.02), link("uwb", 9.5, anchors="ABC", lost=2, corrupt={"sum": 1, "end": 3}),
        link("odometry", 20.0, quiet=True), link("gyro", 5.0, port=None, corrupt={"x": 1}),
    ]  # fmt: skip
    log = SimpleNamespace(bytes=2_340_000, free_bytes=lambda: 12_340_000_000)
    assert record.status_text(SimpleNamespace(links=links, log=log)) == (
        "2.3 MB | lidar 10.0/s | uwb 9.5/s (3 anchors) lost 2 corrupt 4 | odometry SILENT | gyro SILENT lost 0 corrupt 1 | "
        "disk 12.3 GB left"
    )


def test_ports_are_opened_by_names_that_last(monkeypatch, capsys):
    links = [link("lidar", 1.0), link("uwb", 1.0)]
    monkeypatch.setattr(record, "stable_name", lambda url: "/dev/serial/by-id/uwb" if url == "/dev/uwb" else None)
    record.use_lasting_names(links)
    assert [each.url for each in links] == ["/dev/lidar", "/dev/serial/by-id/uwb"]
    assert capsys.readouterr().err == "uwb: /dev/uwb may change its number; it is opened as /dev/serial/by-id/uwb\n"


def test_lines_that_go_nowhere_else_are_counted_and_handed_on():
    taken = []
    log = record.LinesTo(taken.append)
    log.write([])
    log.write(["ODOM 1", "\u00b5 2"])
    assert (taken, log.bytes) == ([b"ODOM 1\n? 2\n"], 11)
    assert log.restore() is False
    log.close()
