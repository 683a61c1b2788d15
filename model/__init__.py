"""What tongues can look like: meshes, the multilinear model, its files. No clock, no device."""

if __name__ != "tonguetrack.model":
    raise ImportError("import tonguetrack.model (the checkout's folder is mapped below that name)")

from .build import load_training_shapes, model_from_shapes, read_sample_database
from .files import load_model, save_model
from .mesh import Mesh, read_mesh
from .multilinear import Mode, SpeakerModel, SurfaceMarks, TongueModel

__all__ = [
    "Mesh",
    "Mode",
    "SpeakerModel",
    "SurfaceMarks",
    "TongueModel",
    "load_model",
    "load_training_shapes",
    "model_from_shapes",
    "read_mesh",
    "read_sample_database",
    "save_model",
]
