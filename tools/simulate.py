"""Simulate a recording: a CARMEN log with odometry, laser scans and UWB ranges, and the truth beside it.

    python tools/simulate.py hall --out hall --seed 1
    python tools/simulate.py hall --out nlos --nlos heavy --nlos-anchors 3,4
    python tools/simulate.py warehouse --out warehouse --gzip

DIR/run.log or run.log.gz            what the robot recorded
DIR/truth.tum                        true poses of the base at the odometry's stamps
DIR/truth_anchors.csv  columns.csv   true places of anchors and named columns
DIR/walls.csv  posts.csv             the building
DIR/truth_calibration.json           true biases, scales, delays, mounting and all settings
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from simulation.logfile import write
from simulation.plans import PLANS
from simulation.radio import NLOS_LEVELS, RadioModel
from simulation.real_rooms import RealRooms
from simulation.recording import FalseRanges, Settings, simulate, with_overrides


def numbers(text: str) -> tuple[float, ...]:
    """Read comma-separated numbers."""
    return tuple(float(part) for part in text.split(","))


def whole_numbers(text: str) -> tuple[int, ...]:
    """Read comma-separated whole numbers."""
    return tuple(int(part) for part in text.split(","))


def false(text: str) -> FalseRanges:
    """Read ANCHOR:START:SECONDS:METRES."""
    anchor, start, seconds, metres = text.split(":")
    return FalseRanges(int(anchor), float(start), float(seconds), float(metres))


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("world", choices=PLANS)
    p.add_argument("--out", type=Path, required=True, metavar="DIR")
    p.add_argument("--gzip", action="store_true", help="write run.log.gz")
    add = p.add_argument
    add("--seed", type=int, default=0)
    add("--minutes", type=float, help="length of the recording; default: as usual for the world")
    add("--speed", type=float, help="m/s (0.2)")
    add("--odometry-rate", type=float, help="Hz (20)")
    add("--odometry-scale", type=float, help="all odometry errors times this (1)")
    add("--slips", type=int, help="wheel-slip events (0)")
    add("--scan-rate", type=float, help="Hz, at most 10 (10)")
    add("--uwb-rate", type=float, help="epochs per second (0.5)")
    add("--anchors", type=int, help="so many anchors at random places")
    add("--anchor-height", type=float, help="m (0.6)")
    add("--tag-height", type=float, help="m (0.6)")
    add("--write-heights", action="store_true", help="write the heights into the log")
    add("--tag", type=numbers, metavar="X,Y", help="place of the tag on the base (-0.05,0)")
    add("--nlos", choices=NLOS_LEVELS, help="how bad occlusion is (normal)")
    add("--nlos-anchors", type=whole_numbers, metavar="I,J", help="anchors, from 1, that --nlos is meant for; default all")
    add("--outliers", type=float, help="share of nonsense ranges (0)")
    add("--zeros", type=float, help="share of ranges that are zero (0)")
    add(
        "--false-range",
        type=false,
        action="append",
        metavar="ANCHOR:START:SECONDS:METRES",
        help="anchor is wrong for a while; repeatable",
    )
    add("--laser-pose", type=numbers, metavar="X,Y,THETA", help="mounting of the laser (0.1,0,0)")
    add("--laser-error", type=numbers, metavar="X,Y,THETA", help="true mounting minus the one in the log (0,0,0)")
    add("--laser-flipped", action="store_true", help="laser upside down, and the log does not say so")
    add("--uwb-delay", type=float, help="s, stamp minus true time (0)")
    add("--laser-delay", type=float, help="s, stamp minus true time (0)")
    add("--robot", type=int, help="which robot, for several recordings of the same one; default: one of the seed's own")
    add("--building", type=int, help="which building of this plan; default: one of the seed's own")
    add("--real-rooms", action="store_true", help="errors that stay with places, walls and floors; people; stops")
    add("--people", type=int, help="people walking about (0)")
    add("--without", action="append", choices=["uwb", "laser"], help="leave a sensor out; repeatable")
    radio = p.add_argument_group("radio")
    for name, unit in (
        ("noise-sd", "m"),
        ("bias-sd", "m"),
        ("multipath-sd", "m"),
        ("multipath-length", "m"),
        ("antenna-sd", "m"),
        ("loss", "share"),
        ("scale", "range reported / distance"),
        ("max-range", "m"),
    ):
        default = getattr(RadioModel(), name.replace("-", "_"))
        radio.add_argument(f"--range-{name}", type=float, help=f"{unit} ({default:g})")
    return p


def settings_from(args: argparse.Namespace) -> Settings:
    """Return the settings the command line asks for."""
    options = vars(args)
    radio = {name[6:]: options.pop(name) for name in list(options) if name.startswith("range_")}
    radio_model = replace(RadioModel(), **{k: v for k, v in radio.items() if v is not None})
    false_ranges, without = options.pop("false_range"), options.pop("without")
    rooms = RealRooms() if options.pop("real_rooms") else None
    values = {k: v for k, v in options.items() if k not in ("out", "gzip")}
    lists = {"false_ranges": tuple(false_ranges or ()), "without": tuple(without or ())}
    return with_overrides(Settings(), radio=radio_model, rooms=rooms, **lists, **values)


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    args = parser().parse_args(argv)
    out, compress = args.out, args.gzip
    recording = simulate(settings_from(args))
    write(recording, out, compress)
    way = abs(recording.truth[1:, :2] - recording.truth[:-1, :2])
    print(
        f"{out}: {recording.stamps[-1] / 60:.1f} min, {((way**2).sum(axis=1) ** 0.5).sum():.0f} m, "
        f"{len(recording.scans)} scans, {len(recording.ranges)} ranges to {len(recording.anchors)} anchors"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
