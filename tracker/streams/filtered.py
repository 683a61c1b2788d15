"""A stream whose poses are calmed on their way: the one-euro filter in front of any worker."""

from __future__ import annotations

from ..pose import FloatArray, TrackedPose
from .oneeuro import OneEuro
from .sink import StreamInfo
from .slot import Worker


class FilteredWorker:
    """Hands on poses whose coefficients went through the filter; everything that is made of them follows.

    It filters in standard deviations, so that the same settings mean the same for every coefficient and model; beta is
    in Hz for one sigma a second. The coils, which are measured, stay as they are, and so do the residuals, which are
    theirs to the pose that was tracked. What is recorded never comes by here.
    """

    def __init__(self, worker: Worker, smooth: OneEuro) -> None:
        self._worker = worker
        self._smooth = smooth
        self._mean: FloatArray | None = None
        self._sigma: FloatArray | None = None
        self._pose: TrackedPose | None = None

    @property
    def destination(self) -> str:
        return self._worker.destination

    def begin(self, info: StreamInfo) -> None:
        self._mean, self._sigma = info.mean, info.sigma
        self._worker.begin(info)

    def work(self, pose: TrackedPose) -> None:
        assert self._mean is not None and self._sigma is not None, "begin() comes before work()"
        if self._pose is None:
            self._pose = pose.copy()
        calm = self._pose
        calm.take(pose)
        calm.normalised[:] = self._smooth(pose.normalised, pose.device_time_s)
        calm.weights[:] = self._mean + calm.normalised * self._sigma
        self._worker.work(calm)

    def end(self) -> None:
        self._worker.end()
