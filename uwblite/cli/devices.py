"""``uwblite devices``: what is plugged in, and what about it needs mending."""

import argparse
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from .console import note, say, say_json

if TYPE_CHECKING:
    from ..drivers.dwm1001_session import Dwm1001Session
    from ..drivers.events import Action, Session
    from ..drivers.scip_session import ScipSession
    from ..drivers.transport import Port

HELP = "list tag, lidar and base that are plugged in, and say how to mend what is not right"
EPILOG = """
examples:
  uwblite devices                              look at every port of a known kind
  uwblite devices /dev/ttyUSB0 /dev/serial0    look at these ports, whatever they are
  uwblite devices --pan-id 0xC0DE              and is the tag in this network?
  uwblite devices --list                       only list ports; nothing is opened

Looking at a port opens it, listens for a moment and asks who is there. Ports of an unknown kind are only opened when they
are named. Nothing is changed: every finding says what to type. Exit code 0: all is well; 1: nothing is there; 3: something
needs mending.
"""

LISTEN, ASK = 0.4, 4.0


@dataclass
class Sight:
    """What was seen on one port."""

    path: str
    kind: str = "unknown"
    details: dict[str, str] = field(default_factory=dict)
    findings: list[tuple[str, str]] = field(default_factory=list)
    """(level, what and how to mend it)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("ports", metavar="PORT", nargs="*", help="ports to look at (default: those of a known kind)")
    parser.add_argument("--list", action="store_true", help="list the ports and open none")
    parser.add_argument("--pan-id", metavar="ID", type=_pan_id, help="network id that the tag should have, e.g. 0xC0DE")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")


def run(args: argparse.Namespace) -> int:
    """Look at the ports and report."""
    from ..drivers.transport import check_url, plugged_in
    from ..errors import DeviceError

    sights = []
    if args.ports:
        for path in args.ports:
            check_url(path)
        sights = [Sight(path) if args.list else look(path, "", args.pan_id) for path in args.ports]
    else:
        for port in plugged_in():
            sight = Sight(port.path)
            if port.guess and not args.list:
                sight = look(port.path, port.guess, args.pan_id)
            sight.details = {"usb": f"{port.usb_id} {port.description}".strip(), **sight.details}
            sights.append(sight)
            if not port.guess:
                sight.findings.append(("info", f"kind not known; `uwblite devices {port.path}` looks at it"))
    if not sights:
        raise DeviceError("no serial device is plugged in; check cables and power, then `dmesg | tail` (see firmware_notes)")
    _compare_networks(sights)
    _report(sights, args.json)
    return 3 if any(level != "info" for sight in sights for level, _ in sight.findings) else 0


def _report(sights: list[Sight], as_json: bool) -> None:
    if as_json:
        rows = [
            {
                "port": sight.path,
                "kind": sight.kind,
                **sight.details,
                "findings": [{"level": level, "text": text} for level, text in sight.findings],
            }
            for sight in sights
        ]
        say_json({"devices": rows})
        return
    for sight in sights:
        say(f"{sight.path}: {sight.kind}")
        for name, value in sight.details.items():
            say(f"    {name}: {value}")
        for level, text in sight.findings:
            say(f"    {level}: {text}")
    if not any(level != "info" for sight in sights for level, _ in sight.findings):
        note("all is well")


def look(path: str, kind: str, pan_id: int | None) -> Sight:
    """Open a port, find out who is there, and judge its settings.

    Parameters
    ----------
    path : of the port.
    kind : "scip", "dwm1001" or "kobuki" where it is known; "" to find out.
    pan_id : network id that a tag should have, None = any.

    Returns
    -------
    Sight
    """
    from ..drivers.dwm1001_session import Dwm1001Session
    from ..drivers.scip_session import ScipSession
    from ..drivers.transport import Port
    from ..errors import DeviceError

    sight = Sight(path)
    try:
        port = Port(path, 115200)
    except DeviceError as error:
        sight.findings.append(("error", str(error)))
        return sight
    try:
        if kind in ("", "kobuki") and _listen_for_base(port, sight):
            return sight
        if kind in ("", "dwm1001"):
            tag = Dwm1001Session(stream=False)
            if _ask(port, tag, sight):
                _judge_tag(tag, sight, pan_id)
                return sight
        if kind in ("", "scip"):
            lidar = ScipSession(stream=False)
            if _ask(port, lidar, sight):
                _judge_lidar(lidar, sight)
                return sight
        sight.findings.append(("error", _SILENT.get(kind, _SILENT[""])))
    except DeviceError as error:
        sight.findings.append(("error", str(error)))
    finally:
        port.close()
    return sight


_SILENT = {
    "": "nobody known answers: is the device powered, and is it a DWM1001 (PANS), a URG-04LX or a Kobuki?",
    "kobuki": "the base is silent: switch it on (its USB chip is powered by this computer, the base is not)",
    "dwm1001": "the tag is silent: unplug and replug it (the USB bridge of the DEV board can hang)",
    "scip": "the lidar is silent: unplug and replug it, check its 5 V supply (it draws up to 0.8 A at start)",
}


def _listen_for_base(port: "Port", sight: Sight) -> bool:
    from ..drivers.kobuki import Feedback, KobukiProtocol

    protocol, packets = KobukiProtocol(), 0
    battery = 0.0
    end = time.monotonic() + LISTEN
    while time.monotonic() < end:
        for event in protocol.feed(port.read(), time.monotonic()):
            if isinstance(event, Feedback):
                packets, battery = packets + 1, event.battery
                if event.wheel_drop:
                    sight.findings = [("warning", "a wheel hangs in the air: travel will be wrong")]
        time.sleep(0.01)
    if packets < 3:
        return False
    sight.kind = "Kobuki base"
    sight.details = {"rate": f"{packets / LISTEN:.0f} packets/s", "battery": f"{battery:.1f} V"}
    if 0 < battery < 13.5:
        sight.findings.append(("warning", f"the battery is low ({battery:.1f} V): charge it before a run"))
    return True


def _ask(port: "Port", session: "Session", sight: Sight) -> bool:
    """Let a session find its device; True when it did."""
    from ..drivers.events import Note, Reopen, Send, SetBaud

    notes: list[Note] = []

    def do(actions: "list[Action]") -> bool:
        for action in actions:
            if isinstance(action, Send):
                port.write(action.data)
            elif isinstance(action, SetBaud):
                port.set_baud(action.rate)
            elif isinstance(action, Note):
                notes.append(action)
            elif isinstance(action, Reopen):
                return False
        return True

    end = time.monotonic() + ASK
    going = do(session.start(time.monotonic()))
    while going and time.monotonic() < end and not getattr(session, "ready", False):
        data = port.read()
        now = time.monotonic()
        going = do(session.feed(data, now)) if data else True
        due = session.deadline()
        if going and due is not None and due <= now:
            going = do(session.tick(now))
        time.sleep(0.003)
    found = bool(getattr(session, "ready", False))
    if found:
        do(session.stop())
    wanted = {"lidar-scip1-only"} if not found else None
    sight.findings += [(n.level, n.text) for n in notes if wanted is None or n.name in wanted]
    return found


def _judge_tag(tag: "Dwm1001Session", sight: Sight, pan_id: int | None) -> None:
    from ..drivers.dwm1001_blocks import short_id

    node = tag.values.get("node_id")
    network = tag.values.get("pan_id", tag.info.pan_id)
    sight.kind = "DWM1001 anchor" if tag.config and tag.config.anchor else "DWM1001 tag"
    if node is not None:
        sight.details["id"] = short_id(node)
    if network is not None:
        sight.details["network"] = f"0x{network:04X}"
    if "firmware" in tag.values:
        sight.details["firmware"] = ".".join(str(b) for b in tag.values["firmware"].to_bytes(4, "big"))
    if tag.rate:
        sight.details["period"] = f"{tag.rate.normal:.1f} s moving, {tag.rate.stationary:.1f} s at rest"
    if tag.joined is not None:
        sight.details["network state"] = "joined" if tag.joined else "not joined"
        if not tag.joined:
            text = "not joined: switch the initiator anchor on; all nodes need the same network id and no update pending"
            sight.findings.append(("warning", text))
    if network == 0:
        sight.findings.append(("error", "the network id is 0: in the shell type `nis 0xC0DE` (with 0x), then `reset`"))
    elif pan_id is not None and network is not None and network != pan_id:
        text = f"the network id is 0x{network:04X}: in the shell type `nis 0x{pan_id:04X}`, then `reset`"
        sight.findings.append(("error", text))


def _judge_lidar(lidar: "ScipSession", sight: Sight) -> None:
    identity, unit = lidar.identity, lidar.geometry
    sight.kind = f"laser scanner {unit.model}"
    for name, key in (("firmware", "FIRM"), ("serial", "SERI"), ("laser", "LASR"), ("state", "STAT")):
        if key in identity:
            sight.details[name] = identity[key]
    sight.details["range"] = f"{unit.distance_min / 1000:.2f} to {unit.distance_max / 1000:.2f} m"
    sight.details["steps"] = f"{unit.first} to {unit.last}, {unit.speed} rev/min"
    if identity.get("LASR") == "OFF":
        sight.findings.append(("info", "the laser is off, as it should be now; `uwblite record` switches it on"))
    state = identity.get("STAT", "")
    if state and "works well" not in state and "Stable" not in state:
        sight.findings.append(("error", f"it reports {state!r}: power it down and up; if that stays, it needs service"))


def _compare_networks(sights: list[Sight]) -> None:
    """Nodes on one computer that are in different networks never hear each other."""
    networks = {sight.details["network"] for sight in sights if "network" in sight.details}
    if len(networks) > 1:
        for sight in sights:
            if "network" in sight.details:
                sight.findings.append(("warning", f"nodes differ in network id ({', '.join(sorted(networks))})"))


def _pan_id(text: str) -> Any:
    try:
        value = int(text, 16)
    except ValueError:
        value = -1
    if not 0 < value <= 0xFFFF:
        raise argparse.ArgumentTypeError(f"{text!r} is not a network id such as 0xC0DE")
    return value
