"""What a take's header says of the run that it is part of."""

from __future__ import annotations

from datetime import datetime

from ... import __version__
from ...drivers.frames import CoilFrame
from ...drivers.sources import Source
from ...model.multilinear import TongueModel
from ..session import session_toml
from ..setup import Setup
from .layout import TakeInfo


def take_info(source: Source, frame: CoilFrame, model: TongueModel, setup: Setup, rate_hz: float) -> TakeInfo:
    """frame: any of the source's, which shows what it has besides positions."""
    return TakeInfo(
        source=source.address,
        coils=source.coils,
        rate_hz=rate_hz,
        frame=source.frame,
        quaternions=frame.quaternions is not None,
        rms=frame.rms is not None,
        status=frame.status is not None,
        roles=setup.roles,
        vertices=setup.vertices,
        model_name=model.name,
        model_fingerprint=model.fingerprint,
        pose_mean=model.pose.mean,
        pose_sigma=model.pose.sigma,
        speaker_size=model.speaker.size,
        session_toml=session_toml(setup.session),
        started=datetime.now().astimezone().isoformat(timespec="milliseconds"),
        version=__version__,
    )
