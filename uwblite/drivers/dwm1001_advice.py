"""Settings of a DWM1001 that make ranges rare or absent, and how to mend each."""

from .events import Note

SHELL = "open a terminal on the port at 115200 bit/s, press Enter twice quickly"


def advise(
    *, tag: bool, active: bool, stationary: bool, joined: bool | None, low_power: bool, period: float
) -> list[Note]:  # fmt: skip
    """Name every setting that hurts.

    Parameters
    ----------
    tag : the node is a tag, not an anchor.
    active : its radio is on.
    stationary : stationary detection is on.
    joined : it is part of a network; None = not known yet.
    low_power : low-power mode is on.
    period : s between fixes.

    Returns
    -------
    list of Note, the worst first.
    """
    notes = []
    if not tag:
        notes.append(Note("error", "not-a-tag", f"uwb: this node is an anchor: {SHELL}, type `nmt` (it restarts)"))
    if tag and not active:
        notes.append(Note("error", "uwb-off", f"uwb: the tag's radio is off or passive: {SHELL}, type `nmt`"))
    if joined is False:
        notes.append(not_joined())
    if stationary:
        text = f"uwb: stationary detection is on: the rate falls to once in 10 s at rest: {SHELL}, `acts` shows its"
        text += " arguments; set accel_en to 0, then `reset` (or set `aurs 1 1` to keep 10 Hz at rest)"
        notes.append(Note("warning", "stationary-detection", text))
    if low_power:
        notes.append(Note("warning", "low-power", f"uwb: low-power mode makes ranges come in bursts: {SHELL}, type `nmt`"))
    if period > 0.1:
        text = f"uwb: a fix only every {period:.1f} s: {SHELL}, type `aurs 1 1` for ten a second"
        notes.append(Note("warning", "slow-update-rate", text))
    return notes


def not_joined() -> Note:
    """Return what to say of a tag without a network."""
    text = (
        "uwb: the tag has not joined a network: one anchor must be the initiator and on, all nodes need the same network"
        " id, and none may be in firmware-update mode"
    )
    return Note("warning", "not-joined", text)
