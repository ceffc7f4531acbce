"""``uwblite devices``: what is plugged in, and what about it needs mending."""

import argparse
import time
from contextlib import closing
from dataclasses import dataclass, field

from ..drivers.devices import DEVICES, SENSORS, DeviceKind, Setup, kinds_on_usb
from ..drivers.events import Action, Note, Reopen, Send, SetBaud, SetDtr
from ..drivers.link import Link
from ..drivers.session import Driver, Session
from ..drivers.transport import Port, check_url, open_port, plugged_in
from ..errors import DeviceError
from .console import note, say, say_json

LISTEN, ASK = 0.6, 5.0
"""s to wait for a device that talks unasked, and for one that answers."""


@dataclass(slots=True)
class PortReport:
    path: str
    kind: str = "unknown"
    found: bool = False
    """Somebody answered."""
    details: dict[str, str] = field(default_factory=dict)
    findings: list[tuple[str, str]] = field(default_factory=list)
    """(level, what and how to mend it)."""

    @property
    def sound(self) -> bool:
        return all(level == "info" for level, _ in self.findings)


def run(args: argparse.Namespace) -> int:
    if args.kinds:
        for kind in (kind for sensor in SENSORS for kind in DEVICES.values() if kind.sensor == sensor):
            say(f"--{kind.sensor} {kind.name}:PORT".ljust(28) + kind.title)
            if kind.options:
                say(f"    options: {kind.options_text()}")
        return 0
    for path in args.ports:
        check_url(path)
    reports = [PortReport(path) if args.list else look(path, [], args.pan_id) for path in args.ports]
    for port in () if args.ports else plugged_in():
        kinds = kinds_on_usb(port.usb_id, port.description)
        seen = look(port.path, kinds, args.pan_id) if kinds and not args.list else PortReport(port.path)
        seen.details = {"usb": f"{port.usb_id} {port.description}".strip(), **seen.details}
        reports.append(seen)
        if not kinds:
            seen.findings.append(("info", f"kind not known; `uwblite devices {port.path}` looks at it"))
    if not reports:
        raise DeviceError(f"no serial device is plugged in; {_PLUG_IN}")
    _compare_networks(reports)
    _report(reports, args.json)
    if not args.ports and not any(":" in seen.details["usb"].split(" ")[0] for seen in reports):
        note(f"no USB device is plugged in; {_PLUG_IN}")
    if not all(seen.sound for seen in reports):
        return 3
    return 0 if args.list or any(seen.found for seen in reports) else 1


_PLUG_IN = "check cables and power, then `dmesg | tail` (see firmware_notes)"


def _report(reports: list[PortReport], as_json: bool) -> None:
    if as_json:
        rows = []
        for seen in reports:
            findings = [{"level": level, "text": text} for level, text in seen.findings]
            rows.append({"port": seen.path, "kind": seen.kind, **seen.details, "findings": findings})
        say_json({"devices": rows})
        return
    for seen in reports:
        say(f"{seen.path}: {seen.kind}")
        for name, value in (*seen.details.items(), *seen.findings):
            say(f"    {name}: {value}")
    if all(seen.found and seen.sound for seen in reports):
        note("all is well")


def look(path: str, kinds: list[DeviceKind], pan_id: int | None) -> PortReport:
    """Open a port, find out who is there among these kinds (none = any), and judge its settings and its network id."""
    seen = PortReport(path)
    tried = kinds or [kind for kind in DEVICES.values() if kind.probe]
    try:
        with closing(open_port(path, Driver.baud)) as port:
            for kind in sorted(tried, key=lambda kind: not kind.talks):
                session = Session(kind.driver({}, Setup(stream=False)))
                port.set_baud(session.baud)
                if _ask(port, session, LISTEN if kind.talks else ASK, seen):
                    network = seen.details.get("network")
                    if pan_id is not None and network not in (None, "0x0000", f"0x{pan_id:04X}"):
                        text = f"the network id is {network}: in the shell type `nis 0x{pan_id:04X}`, then `reset`"
                        seen.findings.append(("error", text))
                    return seen
        known = ", ".join(kind.title for kind in tried)
        silent = f"nobody known answers: is the device powered, and is it one of these: {known}?"
        seen.findings.append(("error", kinds[0].silent if kinds else silent))
    except DeviceError as error:
        seen.findings.append(("error", str(error)))
    return seen


def _ask(port: Port, session: Session, patience: float, seen: PortReport) -> bool:
    """Let a device's session find it, for so long, s; True when it did."""
    driver, notes, link = session.driver, list[Note](), Link("", seen.path, session)
    link.port = port

    def do(actions: list[Action]) -> bool:
        for action in actions:
            if isinstance(action, Send | SetBaud | SetDtr):
                link.send(action)
        notes.extend(action for action in actions if isinstance(action, Note))
        return not any(isinstance(action, Reopen) for action in actions)

    end = time.monotonic() + patience
    going = do(session.start(time.monotonic()))
    while going and time.monotonic() < end and not driver.ready:
        data = port.read()
        now = time.monotonic()
        going = do(session.feed(data, now)) if data else True
        going = going and do(session.tick(now))
        time.sleep(0.003)
    if not driver.ready:
        seen.findings += [(note.level, note.text) for note in notes if note.name == "lidar-scip1-only"]
        return False
    do(session.stop())
    identity = driver.identity()
    seen.found, seen.kind, seen.details = True, identity.title, dict(identity.details)
    output = {note.name for note in identity.findings}
    shown = [*identity.findings, *(note for note in notes if note.name not in output)]
    seen.findings += [(note.level, note.text) for note in shown]
    return True


def _compare_networks(reports: list[PortReport]) -> None:
    """Nodes on one computer that are in different networks never reach each other."""
    nodes = [seen for seen in reports if "network" in seen.details]
    if len(networks := {seen.details["network"] for seen in nodes}) > 1:
        for seen in nodes:
            seen.findings.append(("warning", f"nodes differ in network id ({', '.join(sorted(networks))})"))
