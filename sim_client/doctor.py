"""``pp-doctor``: checks whether this computer can run the servers and the simulator, and names commands to fix it."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import tyro

from protocol.command_line import command, parse
from protocol.options import LinkOptions
from protocol.sockets import endpoint
from sim_client import certs, doctor_schedule
from sim_client import doctor_probes as look
from sim_client.doctor_probes import Finding, Level, Role
from sim_client.doctor_schedule import ScheduleProbeOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """One check, the kinds of computer that need it, and whether episodes run without it."""

    name: str
    look: Callable[[], Finding]
    is_required: bool = True
    roles: tuple[Role, ...] = ("robot", "models", "clock")


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorConfig:
    """Checks this computer; exit code 1: something required is missing. `pp-doctor certs` makes TLS certificates."""

    role: Role = "all"
    """Role of this computer. robot: simulator and logs, no torch; models: PONDER and POUNCE, no MuJoCo; all: both.
    clock: neither, as beside a real robot or in front of a policy that runs elsewhere."""
    extras: tuple[str, ...] = ()
    """Further extras of ponderpounce-server, such as gateway, whose packages are checked."""
    required_only: bool = False
    """Check only what episodes need."""
    json: bool = False
    """Print one JSON object instead of a table."""
    out: Path = Path("out")
    """Folder for logs, whose disk is checked."""
    ponder_checkpoint: Path | None = None
    """Folder of a PONDER checkpoint, whose files are checked."""
    pounce_checkpoint: Path | None = None
    """Folder of a POUNCE checkpoint, whose files are checked."""
    schedule: bool = False
    """Check only whether running models are fast enough: d <= s <= H - d, see docs/clock.md."""
    models: tyro.conf.OmitArgPrefixes[ScheduleProbeOptions] = field(default_factory=ScheduleProbeOptions)
    link: LinkOptions = field(default_factory=lambda: LinkOptions(connect=(endpoint("ponder"), endpoint("pounce"))))


def probes(config: DoctorConfig) -> list[Probe]:
    """Returns the checks that the configuration asks for."""
    if config.schedule:
        asked = doctor_schedule.probes(config.models, config.link)
        return [Probe(name=name, look=answer) for name, answer in asked.items()]
    backend = os.environ.get("MUJOCO_GL", "egl")
    other = "osmesa" if backend == "egl" else "egl"
    found = [
        Probe(name="python", look=look.python),
        Probe(name="packages", look=partial(look.packages, config.role, config.extras)),
        Probe(name="zenoh", look=look.zenoh_loopback),
        Probe(name="torch", look=look.torch, roles=("models",)),
        Probe(name=f"gl {backend}", look=partial(look.gl, backend), roles=("robot",)),
        Probe(name="robosuite", look=look.robosuite, roles=("robot",)),
        Probe(name="disk", look=partial(look.disk, config.out), roles=("robot", "clock")),
        Probe(name="sockets", look=look.sockets, is_required=False),
        Probe(name="cpu", look=look.cpu, is_required=False),
        Probe(name="clock", look=look.clock, is_required=False),
        Probe(name=f"gl {other}", look=partial(look.gl, other), is_required=False, roles=("robot",)),
        Probe(name="rerun", look=look.rerun, is_required=False, roles=("robot",)),
    ]
    for kind, folder in (("ponder", config.ponder_checkpoint), ("pounce", config.pounce_checkpoint)):
        if folder is not None:
            answer = partial(look.checkpoint, kind, folder)
            found.append(Probe(name=f"{kind} checkpoint", look=answer, roles=("models",)))
    return [
        probe
        for probe in found
        if (config.role == "all" or config.role in probe.roles) and (probe.is_required or not config.required_only)
    ]


def examine(probes: Sequence[Probe]) -> Iterator[Finding]:
    """Runs one probe after the other. An optional check cannot fail, and a probe that raises has failed."""
    for probe in probes:
        try:
            finding = probe.look()
        except Exception as error:  # the doctor must not be the patient
            text = f"the probe itself failed: {type(error).__name__}: {error}"
            finding = Finding(probe.name, Level.FAILED, text)
        level = finding.level
        if level is Level.FAILED and not probe.is_required:
            level = Level.WARNING
        yield Finding(probe.name, level, finding.text, finding.way_out)


def table(findings: Sequence[Finding]) -> str:
    """Returns one line per finding, its remedy beneath."""
    width = max((len(f.name) for f in findings), default=0)
    lines = []
    for finding in findings:
        lines.append(f"{finding.level.value:<7}  {finding.name:<{width}}  {finding.text}")
        if finding.way_out:
            lines.append(f"{'':<7}  {'':<{width}}  -> {finding.way_out}")
    failed = [f.name for f in findings if f.level is Level.FAILED]
    lines.append(f"not fit: {', '.join(failed)}" if failed else "fit: everything required is there")
    return "\n".join(lines) + "\n"


@command("pp-doctor")
def main(argv: list[str] | None = None) -> int:
    arguments = sys.argv[1:] if argv is None else argv
    if arguments[:1] == ["certs"]:
        return certs.main(arguments[1:])
    config = parse(DoctorConfig, arguments, prog="pp-doctor")
    findings = list(examine(probes(config)))
    is_fit = not any(finding.level is Level.FAILED for finding in findings)
    if config.json:
        sys.stdout.write(json.dumps({"is_fit": is_fit, "findings": [f._asdict() for f in findings]}) + "\n")
    else:
        sys.stdout.write(table(findings))
    return 0 if is_fit else 1


if __name__ == "__main__":
    sys.exit(main())
