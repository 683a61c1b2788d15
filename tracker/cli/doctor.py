"""`tonguetrack doctor`: looks at this machine and says what to do."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict


def add_commands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `doctor`."""
    doctor = subparsers.add_parser(
        "doctor",
        help="check ports, clock, serial permissions, compiled code and disk, and say what to do",
        description="Checks whether this machine is fit for live tracking. Nothing is changed and no device is opened. "
        "Exit code 1 if something is a problem.",
    )
    doctor.add_argument("--json", action="store_true", help="print the findings as JSON")
    doctor.set_defaults(run=run_doctor)


def run_doctor(args: argparse.Namespace) -> int:
    """Print one row a finding."""
    from ..doctor import examine

    findings = examine()
    problems = sum(finding.state == "problem" for finding in findings)
    if args.json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
        return 1 if problems else 0
    width = max(len(finding.what) for finding in findings)
    for finding in findings:
        print(f"{finding.state:<7}  {finding.what:<{width}}  {finding.found}")
        if finding.advice:
            print(f"{'':<{width + 9}}  -> {finding.advice}")
    notes = sum(finding.state == "note" for finding in findings)
    print(f"{_count(problems, 'problem')}, {_count(notes, 'note')}")
    return 1 if problems else 0


def _count(number: int, word: str) -> str:
    return f"{number or 'no'} {word}{'' if number == 1 else 's'}"
