"""What the devices of a recording did, in sentences; a recording lasts from start to end, s."""

from .link import Link


def summary_lines(links: list[Link], start: float, end: float) -> list[str]:
    """Return what each device did, for people."""
    lines = []
    for link in links:
        counts = link.counts
        text = (
            f"{link.name}: {counts.messages} messages ({counts.messages / max(end - start, 1e-9):.2f}/s),"
            f" lost {counts.lost}, corrupt {sum(counts.corrupt.values())}, connected {counts.connects} times,"
            f" silent {link.silent_time(start, end):.1f} s"
        )
        if counts.anchors:
            text += "; anchors " + ", ".join(f"{name} {count}" for name, count in sorted(counts.anchors.items()))
        if counts.widest:
            mean = counts.spread / counts.messages
            text += f"; stamps within {1000 * mean:.1f} ms on average, {1000 * counts.widest:.1f} ms at worst"
        lines.append(text)
        lines += [f"{link.name}: corrupt {count} times: {why}" for why, count in counts.corrupt.most_common(8)]
    return lines


def doubts(links: list[Link], start: float, end: float) -> list[str]:
    """Return why a recording should not be trusted; empty when it can be."""
    seconds, found = max(end - start, 1e-9), []
    for link in links:
        counts = link.counts
        silent, total = link.silent_time(start, end), counts.messages + counts.lost
        if not counts.messages:
            found.append(f"{link.name}: no data at all")
        elif silent > 0.1 * seconds:
            found.append(f"{link.name}: silent for {silent:.0f} s of {seconds:.0f} s")
        elif counts.lost > 0.1 * total:
            found.append(f"{link.name}: lost {counts.lost} of {total}")
    return found
