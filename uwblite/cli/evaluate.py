"""`uwblite evaluate`: compare a result with the truth."""

import argparse

from .options import number, place

HELP = "compare a map, its trajectory and anchors with the truth"
EPILOG = """\
examples:
  uwblite evaluate map/ --truth truth.tum
  uwblite evaluate map/ --truth truth.tum --anchors truth_anchors.csv --landmarks columns.csv
  uwblite evaluate map/ --truth truth.tum --json
  uwblite evaluate map/ --relations truth.relations.gz
  uwblite evaluate both/ --truth monday.tum --truth tuesday.tum    a map of two recordings
  uwblite evaluate both/ --truth tuesday.tum --recording 2         only the second of them

The trajectory is aligned with the truth by the best rigid motion, without scale; ATE and RPE are those of evo_ape -a and
evo_rpe. Several truths, in one frame, are of the recordings in their order: each is judged alone and all together, under
one motion. Columns are searched in the map; the distances between them are what is judged.

files (lengths in metres):
  --truth      stamp x y z qx qy qz qw        identity quaternions throughout = the heading is not known
  --anchors    id,x,y
  --landmarks  name,x,y,radius[,neighbours]   neighbours: names separated by blanks; only these distances are judged
  --walls      x1,y1,x2,y2
  --relations  stamp1 stamp2 x y z roll pitch yaw: the scan of stamp2 as seen from that of stamp1. Poses are asked at the
               lidar's clock, as the map found it; relations without an answer are counted and reported
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("dir", help="folder that uwblite map wrote: trajectory.tum, anchors.csv, map.yaml")
    parser.add_argument("--truth", type=place, metavar="FILE.tum", action="append", help="true poses; one per recording")
    parser.add_argument("--relations", type=place, metavar="FILE", help="true relative poses of scans (Kuemmerle et al. 2009)")
    counted, length = number(above=0, whole=True), number(above=0)
    parser.add_argument("--recording", metavar="N", type=counted, help="the recording that a single truth is of (1)")
    parser.add_argument("--anchors", type=place, metavar="FILE.csv", help="true anchors")
    parser.add_argument("--landmarks", type=place, metavar="FILE.csv", help="true columns")
    parser.add_argument("--walls", type=place, metavar="FILE.csv", help="true walls")
    parser.add_argument("--delta", type=length, default=1.0, metavar="M", help="m of path per stretch of the RPE (1)")
    parser.add_argument("--max-gap", type=length, default=1.0, metavar="S", help="leave out truth in longer gaps, s (1)")
    parser.add_argument("--search-radius", type=length, default=1.0, metavar="M", help="m around a column's place (1)")
    parser.add_argument("--tolerance", type=length, default=0.1, metavar="M", help="m from a wall that count as on it (0.1)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    from ..errors import ConfigError, UsageError
    from . import console
    from .comparison import compare

    if not args.truth and not args.relations:
        raise UsageError("give --truth, --relations, or both")
    if not args.truth and (args.anchors or args.landmarks or args.walls):
        raise UsageError("--anchors, --landmarks and --walls need --truth, which lays the map over them")
    if args.recording and len(args.truth or ()) > 1:
        raise ConfigError("--recording is for a single --truth; several are of recording 1, 2, ...")
    console.report(args.json, *compare(args))
    return 0
