"""A simulated NDI Aurora or Polaris that speaks the combined API: bytes in, replies out, no sockets.

After NDI's published API guides, the open clients of it, and IGSTK's recordings of real devices, from which
are taken: what PHINF says of a port before and after PINIT, that the second sensor of a dual tool appears
with the PINIT of the first, that a tool is MISSING with frame 0 until something was measured, that a handle
not enabled is DISABLED without status, and how long each command takes. `ndi_sim` connects it to the world.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ... import InputError
from ..devices.ndi import (
    BAUD_CODES,
    OKAY,
    RESET_REPLY,
    NdiDamaged,
    NdiError,
    PortHandle,
    PortInformation,
    PortLocation,
    ToolInformation,
    encode_phinf,
    encode_phsr,
    error_reply,
    parse_command,
    reply,
)
from ..devices.ndi_tracking import (
    OUT_OF_VOLUME_TOO,
    REPLY_OPTIONS,
    TRANSFORMS,
    State,
    ToolState,
    TrackingReply,
    encode_bx,
    encode_tx,
)
from .faults import FaultPlan, Misbehaviour
from .motion import DeviceFrame, SimulatedMotion

POWER_ON_BAUD = 9600
MAX_COMMAND = 256  # the longest command of the API, PVWR, has 144 bytes
MAX_COILS = 64
MAX_HANDLES = 96
FIRST_HANDLE = 0x0A
CATCH_UP = 256
"""A client that polls rarely misses measurements; at most so many are gone through for its next reply."""

OCCUPIED, SWITCHES, INITIALISED, ENABLED, OUT_OF_VOLUME = 0x01, 0x0E, 0x10, 0x20, 0x40
MEMORY_STEP, MEMORY_END = 0x40, 0x400
_BAUDS = {code: baud for baud, code in BAUD_CODES.items()}


@dataclass(frozen=True)
class NdiModel:
    """One make of device. step: what the frame counter grows by; sensors: sensors a tool has; lag: by how many
    frames the counter of a tool that is not seen stays behind; error: what is reported as the fit error."""

    name: str
    step: int
    sensors: int
    five_degrees: bool
    lag: int
    error: float
    serial: str
    firmware: str
    tag: str
    revision: str
    part: str


MODELS = {
    "aurora": NdiModel(
        "Aurora", 8, 2, True, 0, 0.0, "A4-SIM01", "013", "AURORA Rev 013", "D.001.007", "SIMULATED TWIN 5DOF"
    ),
    "polaris": NdiModel(
        "Polaris", 1, 1, False, 2, 0.05, "P4-SIM01", "024", "POLARIS Rev 024", "G.001.005", "SIMULATED TOOL"
    ),
}  # fmt: skip

MEASURED_S = {
    "INIT": 0.032,
    "COMM": 0.059,
    "VER": 0.013,
    "PHSR": 0.019,
    "PHINF": 0.017,
    "PINIT": 2.5,
    "PENA": 0.021,
    "PDIS": 0.120,
    "PHF": 0.150,
    "PVWR": 0.026,
    "TSTART": 1.6,
    "TSTOP": 0.332,
    "TX": 0.016,
    "BX": 0.016,
}
"""How long a real Aurora takes to answer, s, without the time on the wire (IGSTK's recordings of 2005)."""
MEASURED_RESET_S = 1.3
RESET_S = 0.3


@dataclass(frozen=True)
class Answer:
    """Bytes that are sent at `baud` after `wait_s`."""

    data: bytes
    baud: int
    wait_s: float = 0.0


@dataclass
class _Port:
    """A port handle. coil: index, -1 = a tool that is loaded by hand and never seen; sensor: of its tool, from 0."""

    handle: int
    coil: int
    number: int
    sensor: int
    initialised: bool = False
    enabled: bool = False
    memory: set[int] = field(default_factory=set)

    @property
    def wired(self) -> bool:
        return self.coil >= 0

    @property
    def status(self) -> int:
        status = OCCUPIED if self.wired or self.memory else 0
        if self.initialised:
            status |= INITIALISED | (SWITCHES if self.wired else 0)
        return status | (ENABLED if self.enabled else 0)


class NdiDevice:
    """The device from power-on. `feed` takes what its port hears and gives what it answers.

    Coil i is seen through handle 0A + i. Both coils of a tool of the Aurora have one serial number, and channels
    00 and 01 of one port. The motion's rate is the device's: 40 Hz is an Aurora's, 60 Hz a Polaris's. Measurements
    are counted while the device tracks, in the model's steps, and a reply has the latest. The faults are those of
    one connection (`faults.Misbehaviour`): a dropped measurement is never reported, a stalled device answers
    nothing and does nothing.

    volume_mm: beyond it, along any axis, a tool is out of volume. realistic: answers take as long as a real
    Aurora's. reset_s: how long a reset takes. now: the clock, s. Raises InputError for more than 64 coils.
    """

    def __init__(
        self,
        motion: SimulatedMotion,
        plan: FaultPlan | None = None,
        model: str = "aurora",
        *,
        volume_mm: float = 500.0,
        realistic: bool = False,
        reset_s: float | None = None,
        now: Callable[[], float] = time.perf_counter,
    ) -> None:
        if len(motion.coils) > MAX_COILS:
            raise InputError(
                f"{len(motion.coils)} coils: a simulated NDI device has up to {MAX_COILS}; choose fewer."
            )
        self.model = MODELS[model]
        self.baud = POWER_ON_BAUD
        self._motion = motion
        self._plan = plan or FaultPlan()
        self._volume_mm = volume_mm
        self._realistic = realistic
        self.reset_s = reset_s if reset_s is not None else MEASURED_RESET_S if realistic else RESET_S
        self._now = now
        self._power_on()

    # --- what happens to it -----------------------------------------------------------------------------------

    @property
    def tracking(self) -> bool:
        return self._tracking

    def connected(self) -> None:
        """A client has connected; the faults' times begin anew with its TSTART."""
        self._line.clear()
        self._too_long = False
        self._misbehaviour = Misbehaviour(self._plan)
        self._streaming_since_s: float | None = None
        self._repeats: deque[DeviceFrame] = deque()

    def reset(self) -> Answer:
        """A BREAK on the serial line: everything is as after power-on."""
        self._power_on()
        return Answer(reply(RESET_REPLY), self.baud, self.reset_s)

    def fail(self) -> None:
        """What `disconnect` means on a serial line: it starts anew and hears only BREAK and INIT."""
        self._power_on()
        self._dumb = True

    def cut(self) -> bool:
        """Whether the connection is to be cut now; each `disconnect` of the plan says so once."""
        return self._misbehaviour.cut(self._streaming_s())

    def feed(self, data: bytes) -> list[Answer]:
        """Takes bytes from the line, in any pieces; gives an answer to each command that they complete."""
        answers = []
        for byte in data:
            if byte != 0x0D:
                if len(self._line) < MAX_COMMAND:
                    self._line.append(byte)
                else:
                    self._too_long = True
                continue
            line, too_long = bytes(self._line), self._too_long
            self._line.clear()
            self._too_long = False
            answer = self._answer(line, too_long)
            if answer is not None:
                answers.append(answer)
        return answers

    # --- commands ---------------------------------------------------------------------------------------------

    def _answer(self, line: bytes, too_long: bool) -> Answer | None:
        if self._misbehaviour.stalled(self._streaming_s()):
            return None
        baud = self.baud  # COMM is answered at the speed at which it came
        name = ""
        try:
            if too_long:
                raise NdiError(0x02)
            name, data = self._execute(line)
        except NdiError as refused:
            data = error_reply(refused.code)
        if self._dumb:
            return None
        wait_s = self.reset_s if name == "RESET" else MEASURED_S.get(name, 0.015) if self._realistic else 0.0
        return Answer(self._misbehaviour.packet(data, self._streaming_s()), baud, wait_s)

    def _execute(self, line: bytes) -> tuple[str, bytes]:
        """The command's name and the whole reply. Raises NdiError."""
        try:
            command = parse_command(line)
        except NdiDamaged as reason:
            raise NdiError(0x01) from reason
        if not command.crc_ok:
            raise NdiError(0x04)
        handler = _COMMANDS.get(command.name)
        if handler is None:
            raise NdiError(0x01)
        if self._dumb and command.name not in ("INIT", "RESET"):
            raise NdiError(0x01)
        self._dumb = False
        if not self._system_ready and command.name not in _BEFORE_INIT:
            raise NdiError(0x0C if command.name in _TRACKING_ONLY else 0x10)
        if self._tracking and command.name in _SETUP_ONLY:
            raise NdiError(0x0C)
        if not self._tracking and command.name in _TRACKING_ONLY:
            raise NdiError(0x0C)
        answer = handler(self, command.arguments)
        return command.name, answer if isinstance(answer, bytes) else reply(answer)

    def _power_on(self) -> None:
        self.baud = POWER_ON_BAUD
        self._line = bytearray()
        self._dumb = False
        self._system_ready = False
        self.connected()
        self._forget()

    def _forget(self) -> None:
        """INIT: no handle is initialised, nothing is tracked, the count begins anew."""
        self._tracking = False
        self._counted = 0
        self._tracking_since_s = 0.0
        self._newest = 0
        self._report: DeviceFrame | None = None
        self._repeats.clear()
        self._ports: dict[int, _Port] = {}
        for coil in range(0, len(self._motion.coils), self.model.sensors):
            self._plug(coil)

    def _plug(self, coil: int) -> None:
        number, sensor = divmod(coil, self.model.sensors)
        self._ports[FIRST_HANDLE + coil] = _Port(FIRST_HANDLE + coil, coil, number + 1, sensor)

    def _port(self, digits: str) -> _Port:
        """The port of a handle in hexadecimal digits. Raises NdiError: 07 no number, 08 no handle, 2B not given out."""
        handle = _hexadecimal(digits, 2)
        if not FIRST_HANDLE <= handle < FIRST_HANDLE + MAX_HANDLES:
            raise NdiError(0x08)
        port = self._ports.get(handle)
        if port is None:
            raise NdiError(0x2B)
        return port

    def _init(self, arguments: str) -> str:
        _expect(arguments, "")
        self._forget()
        self._system_ready = True
        return OKAY

    def _reset(self, arguments: str) -> str:
        _expect(arguments, "", "0", "1")
        self._power_on()
        return RESET_REPLY

    def _comm(self, arguments: str) -> str:
        if len(arguments) != 5 or arguments[0].upper() not in _BAUDS:
            raise NdiError(0x07)
        for character, choices in zip(arguments[1:], ("01", "012", "01", "01"), strict=True):
            if character not in choices:
                raise NdiError(0x07)
        self.baud = _BAUDS[arguments[0].upper()]
        return OKAY

    def _ver(self, arguments: str) -> str:
        _expect(arguments, "", "0", "3", "4", "5", "7", "8")
        part = {"7": "Field Generator", "8": "Sensor Interface Unit"}.get(arguments, "Control Firmware")
        model = self.model
        return (
            f"{model.name} {part}\nNDI S/N: {model.serial}\nCharacterization Date: 01-01-2024\n"
            f"Freeze Tag: {model.tag}\nFreeze Date: 01/01/24\nSimulated by tonguetrack\n"
        )

    def _beep(self, arguments: str) -> str:
        _expect(arguments, *"123456789")
        return "1"

    def _phsr(self, arguments: str) -> str:
        _expect(arguments, "", "00", "01", "02", "03", "04")
        ports = [self._ports[handle] for handle in sorted(self._ports)]
        group = {
            "01": lambda port: False,  # a wired tool that was unplugged; here nobody unplugs one
            "02": lambda port: not port.initialised,
            "03": lambda port: port.initialised and not port.enabled,
            "04": lambda port: port.enabled,
        }.get(arguments, lambda port: True)
        return encode_phsr(tuple(PortHandle(port.handle, port.status) for port in ports if group(port)))

    def _phinf(self, arguments: str) -> str:
        if len(arguments) not in (2, 6):
            raise NdiError(0x07)
        port = self._port(arguments[:2])
        options = _hexadecimal(arguments[2:] or "0001", 4)
        if not options or options & ~0x007F:
            raise NdiError(0x07)
        tool = ToolInformation(0, "", "000", "00000000", port.status)
        if port.initialised:
            serial = f"51{port.number:06X}"
            tool = ToolInformation(0x02, "SIMULATED", "001", serial, port.status)
        place = PortLocation(self.model.serial, "1", "0", f"{port.number:02X}", f"{port.sensor:02X}")
        if not port.wired:
            place = PortLocation("0" * 8, "0", f"{port.number % 10}", "00", "00")
        return encode_phinf(
            PortInformation(tool, self.model.part if port.initialised else "", place), options
        )

    def _pinit(self, arguments: str) -> str:
        port = self._port(arguments)
        if not port.wired and not port.memory:
            raise NdiError(0x2C)
        if not port.wired and len(port.memory) < MEMORY_END // MEMORY_STEP:
            raise NdiError(0x13)
        port.initialised = True
        if port.wired and port.sensor == 0:
            coils = range(port.coil + 1, min(port.coil + self.model.sensors, len(self._motion.coils)))
            for coil in coils:
                self._plug(coil)
                self._ports[FIRST_HANDLE + coil].initialised = True
        return OKAY

    def _pena(self, arguments: str) -> str:
        if len(arguments) != 3 or arguments[2].upper() not in "SDB":
            raise NdiError(0x07)
        port = self._port(arguments[:2])
        if not port.initialised:
            raise NdiError(0x0E)
        port.enabled = True
        return OKAY

    def _pdis(self, arguments: str) -> str:
        port = self._port(arguments)
        if not port.initialised:
            raise NdiError(0x0E)
        if not port.enabled:
            raise NdiError(0x0F)
        port.enabled = False
        return OKAY

    def _phf(self, arguments: str) -> str:
        del self._ports[self._port(arguments).handle]
        return OKAY

    def _phrq(self, arguments: str) -> str:
        if len(arguments) != 14:
            raise NdiError(0x07)
        taken = len(self._motion.coils)
        handle = next(
            (h for h in range(FIRST_HANDLE + taken, FIRST_HANDLE + MAX_HANDLES) if h not in self._ports), None
        )
        if handle is None:
            raise NdiError(0x23)
        self._ports[handle] = _Port(handle, -1, handle - FIRST_HANDLE - taken + 1, 0)
        return f"{handle:02X}"

    def _pvwr(self, arguments: str) -> str:
        if len(arguments) != 6 + 2 * MEMORY_STEP:
            raise NdiError(0x07)
        port = self._port(arguments[:2])
        address = _hexadecimal(arguments[2:6], 4)
        _hexadecimal(arguments[6:], 2 * MEMORY_STEP)
        if address % MEMORY_STEP or address >= MEMORY_END:
            raise NdiError(0x23)
        port.memory.add(address)
        return OKAY

    def _led(self, arguments: str) -> str:
        if len(arguments) != 4:
            raise NdiError(0x07)
        port = self._port(arguments[:2])
        if arguments[2] not in "123":
            raise NdiError(0x0A)
        if arguments[3].upper() not in "BFS":
            raise NdiError(0x0B)
        if not port.initialised:
            raise NdiError(0x0E)
        if not port.enabled:
            raise NdiError(0x0F)
        return OKAY

    def _tstart(self, arguments: str) -> str:
        _expect(arguments, "", "40", "80")
        if arguments == "80":
            self._counted = 0
        self._newest = self._counted
        self._tracking_since_s = self._now()
        if self._streaming_since_s is None:
            self._streaming_since_s = self._tracking_since_s
        self._report = None
        self._repeats.clear()
        self._tracking = True
        return OKAY

    def _tstop(self, arguments: str) -> str:
        _expect(arguments, "")
        self._counted = self._latest()
        self._tracking = False
        return OKAY

    def _tx(self, arguments: str) -> str:
        options = _reply_options(arguments)
        return encode_tx(self._measurement(options), options)

    def _bx(self, arguments: str) -> bytes:
        options = _reply_options(arguments)
        return encode_bx(self._measurement(options), options)

    def _gx(self, arguments: str) -> str:
        """The transforms of the first three handles, and their status, last one first, after the system's."""
        _expect(arguments, "", "0001")
        tools = self._measurement(TRANSFORMS).tools[:3]
        text = ""
        for tool in tools:
            # The same fields as TX has, without handle, status and frame.
            line = encode_tx(TrackingReply((tool,)), TRANSFORMS).partition("\n")[0][4:]
            text += (line[:-16] if tool.state in (State.VALID, State.MISSING) else line) + "\n"
        text += "DISABLED\n" * (3 - len(tools))
        statuses = [tool.port_status & 0xFF for tool in tools] + [0] * (3 - len(tools))
        return text + "00" + "".join(f"{status:02X}" for status in reversed(statuses))

    def _get(self, arguments: str) -> str:
        values = self._parameters()
        if arguments.endswith("*"):
            found = {name: value for name, value in values.items() if name.startswith(arguments[:-1])}
        else:
            found = {name: values[name] for name in [arguments] if name in values}
        if not found:
            raise NdiError(0x07)
        return "".join(f"{name}={value}\n" for name, value in found.items())

    def _parameters(self) -> dict[str, str]:
        return {
            "Features.Firmware.Version": self.model.firmware,
            "Features.Hardware.Serial Number": self.model.serial,
            "Features.Hardware.Model": f"{self.model.name} (simulated)",
            "Param.Tracking.Frame Frequency": f"{self._motion.rate_hz:g}",
            "Param.Tracking.Selected Volume": "0",
            "Param.User.String0": "",
            "Info.Timeout.INIT": "5",
            "Info.Timeout.PINIT": "5",
            "Info.Timeout.TSTART": "5",
            "Info.Status.System Status": "0",
        }

    def _apirev(self, arguments: str) -> str:
        _expect(arguments, "")
        return self.model.revision

    def _echo(self, arguments: str) -> str:
        return arguments

    def _sflist(self, arguments: str) -> str:
        _expect(arguments, "00", "01", "02", "03", "04", "05", "10", "11", "12")
        if arguments == "00":
            return "00000037"
        return f"{min(9, len(self._ports))}" if arguments in ("01", "02", "10", "12") else "0"

    def _sstat(self, arguments: str) -> str:
        return "00" * (_hexadecimal(arguments, 4) & 0x0007).bit_count()

    # --- measurements -----------------------------------------------------------------------------------------

    def _streaming_s(self) -> float:
        """Seconds since the connection's first TSTART; before it, a time at which no fault is due."""
        return -1.0 if self._streaming_since_s is None else self._now() - self._streaming_since_s

    def _latest(self) -> int:
        """The number of the newest measurement by now; 0 = none yet."""
        return self._counted + int((self._now() - self._tracking_since_s) * self._motion.rate_hz)

    def _reported(self) -> DeviceFrame | None:
        """The measurement that a reply is about; None before the first."""
        latest = self._latest()
        for number in range(max(self._newest + 1, latest - CATCH_UP + 1), latest + 1):
            measured_s = self._streaming_s() - (latest - number) / self._motion.rate_hz
            reports = self._misbehaviour.frames(self._motion.frame(number), measured_s)
            if reports:
                self._repeats = deque(reports)
        self._newest = latest
        if self._repeats:
            self._report = self._repeats.popleft()
        return self._report

    def _measurement(self, options: int) -> TrackingReply:
        frame = self._reported()
        ports = [self._ports[handle] for handle in sorted(self._ports)]
        return TrackingReply(tuple(self._tool(port, frame, options) for port in ports))

    def _tool(self, port: _Port, frame: DeviceFrame | None, options: int) -> ToolState:
        if not port.enabled:
            return ToolState(port.handle, State.DISABLED, port_status=port.status)
        if frame is None:
            return ToolState(port.handle, State.MISSING, port_status=port.status)
        # The faults shift a frame's time; the counter is that time in the device's own steps.
        count = max(0, round(frame.time_us / self._motion.period_us))
        number = count * self.model.step & 0xFFFFFFFF
        position = frame.positions[port.coil] if port.wired else np.full(3, np.nan)
        seen = bool(np.isfinite(position).all())
        within = seen and bool((np.abs(position) <= self._volume_mm).all())
        status = port.status | (0 if within else OUT_OF_VOLUME)
        if not seen or (not within and not options & OUT_OF_VOLUME_TOO):
            behind = max(0, count - self.model.lag) * self.model.step & 0xFFFFFFFF
            return ToolState(port.handle, State.MISSING, port_status=status, frame_number=behind)
        q0, qx, qy, qz = frame.quaternions[port.coil].tolist()
        quaternion = without_roll(q0, qx, qy, qz) if self.model.five_degrees else (q0, qx, qy, qz)
        x, y, z = position.tolist()
        return ToolState(port.handle, State.VALID, quaternion, (x, y, z), self.model.error, status, number)


def without_roll(w: float, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """The rotation with qz = 0 that turns the z axis to the same direction: all that a sensor with five degrees
    of freedom can tell. Takes and gives a unit quaternion (w, x, y, z)."""
    size = float(np.hypot(w, z))
    if size < 1e-12:  # the z axis is turned around: any turn about it is as good
        return (0.0, x, y, 0.0)
    cosine, sine = w / size, -z / size
    return (size, x * cosine + y * sine, y * cosine - x * sine, 0.0)


def _expect(arguments: str, *choices: str) -> None:
    if arguments not in choices:
        raise NdiError(0x07)


def _hexadecimal(text: str, digits: int) -> int:
    if len(text) != digits or not all(character in "0123456789ABCDEFabcdef" for character in text):
        raise NdiError(0x07)
    return int(text, 16)


def _reply_options(arguments: str) -> int:
    options = _hexadecimal(arguments or "0001", 4)
    if not options or options & ~REPLY_OPTIONS:
        raise NdiError(0x07)
    return options


_COMMANDS: dict[str, Callable[[NdiDevice, str], str | bytes]] = {
    "INIT": NdiDevice._init,
    "RESET": NdiDevice._reset,
    "COMM": NdiDevice._comm,
    "VER": NdiDevice._ver,
    "BEEP": NdiDevice._beep,
    "PHSR": NdiDevice._phsr,
    "PHINF": NdiDevice._phinf,
    "PINIT": NdiDevice._pinit,
    "PENA": NdiDevice._pena,
    "PDIS": NdiDevice._pdis,
    "PHF": NdiDevice._phf,
    "PHRQ": NdiDevice._phrq,
    "PVWR": NdiDevice._pvwr,
    "LED": NdiDevice._led,
    "TSTART": NdiDevice._tstart,
    "TSTOP": NdiDevice._tstop,
    "TX": NdiDevice._tx,
    "BX": NdiDevice._bx,
    "GX": NdiDevice._gx,
    "GET": NdiDevice._get,
    "GETINFO": NdiDevice._get,
    "APIREV": NdiDevice._apirev,
    "ECHO": NdiDevice._echo,
    "SFLIST": NdiDevice._sflist,
    "SSTAT": NdiDevice._sstat,
}
_BEFORE_INIT = {"INIT", "RESET", "COMM", "VER", "BEEP", "GET", "GETINFO", "APIREV", "ECHO", "SFLIST"}
_SETUP_ONLY = {"COMM", "PINIT", "PENA", "PDIS", "PHF", "PHRQ", "PVWR", "TSTART"}
_TRACKING_ONLY = {"TX", "BX", "GX", "TSTOP"}
