"""Compare a log of `uwblite record` with what tools/emulate.py says it sent (--truth).

    python tools/compare_recording.py run.log truth.jsonl [--json]

Per sensor: messages sent between the first and the last one recorded, how many of them are missing from the log, how many
are there whose content nobody sent, and the error of the stamps (recorded minus true; median, 95 %, largest), ms.
"""

import argparse
import json
import sys
from bisect import bisect_left
from pathlib import Path

REACH = {"lidar": 0.045, "uwb": 0.045, "odometry": 0.009}
"""s; a recorded message and a sent one further apart than this are not the same."""


def read_log(path: Path) -> dict[str, list[tuple[float, object]]]:
    """Return (stamp on the monotonic clock, content) per sensor."""
    found: dict[str, list[tuple[float, object]]] = {name: [] for name in REACH}
    zero = 0.0
    for line in path.read_text(encoding="ascii", errors="replace").splitlines():
        fields = line.split()
        if len(fields) < 5:
            continue
        if fields[0] == "PARAM" and fields[1] == "host_monotonic_zero":
            zero = float(fields[2])
        elif fields[0] == "ODOM":
            found["odometry"].append((float(fields[-3]) - zero, None))
        elif fields[0] == "UWB":
            stamp, reading = float(fields[-3]) - zero, (int(fields[1], 16), round(1000 * float(fields[2])))
            if found["uwb"] and found["uwb"][-1][0] == stamp:
                found["uwb"][-1][1].append(reading)
            else:
                found["uwb"].append((stamp, [reading]))
        elif fields[0] == "ROBOTLASER1":
            count = int(fields[8])
            found["lidar"].append((float(fields[-3]) - zero, fields[9 : 9 + count]))
    return found


def expected(name: str, content: object) -> object:
    """Return the content of a truth line as the log has it."""
    if name == "uwb":
        return [(a, mm) for a, mm, _ in content]
    if name == "lidar":
        return [f"{(5600 if v in (0, 6) else 0 if v < 20 else min(v, 5600)) / 1000:.3f}" for v in content]
    return None


def compare(log: Path, truth: Path) -> dict[str, dict[str, float]]:
    """Return the counts and stamp errors per sensor."""
    recorded = read_log(log)
    sent: dict[str, list[tuple[float, object]]] = {name: [] for name in REACH}
    with truth.open(encoding="ascii") as file:
        for line in file:
            name, stamp, content = json.loads(line)
            sent[name].append((stamp, expected(name, content)))
    report = {}
    for name, items in recorded.items():
        if not items:
            continue
        items.sort(key=lambda item: item[0])
        stamps = [stamp for stamp, _ in sent[name]]
        matched: dict[int, float] = {}
        items = [item for item in items if stamps and item[0] >= stamps[0] - REACH[name]]
        foreign = 0
        for stamp, content in items:
            near = bisect_left(stamps, stamp)
            near = min((i for i in (near - 1, near) if 0 <= i < len(stamps)), key=lambda i: abs(stamps[i] - stamp))
            if abs(stamps[near] - stamp) > REACH[name] or sent[name][near][1] != content or near in matched:
                foreign += 1
            else:
                matched[near] = stamp - stamps[near]
        errors = sorted(abs(error) for error in matched.values())
        first, last = min(matched, default=0), max(matched, default=-1)
        signed = sorted(matched.values())
        report[name] = {
            "sent": last - first + 1,
            "missing": last - first + 1 - len(matched),
            "foreign": foreign,
            "median_ms": 1000 * signed[len(signed) // 2] if signed else 0.0,
            "p95_ms": 1000 * errors[int(0.95 * len(errors))] if errors else 0.0,
            "max_ms": 1000 * errors[-1] if errors else 0.0,
        }
    return report


def main() -> int:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    report = compare(args.log, args.truth)
    if args.json:
        print(json.dumps(report, indent=2))
    else:
        for name, row in report.items():
            print(
                f"{name}: sent {row['sent']}, missing {row['missing']}, foreign {row['foreign']}; stamp error median"
                f" {row['median_ms']:+.2f} ms, 95 % {row['p95_ms']:.2f} ms, largest {row['max_ms']:.2f} ms"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
