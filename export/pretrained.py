"""`python -m export.pretrained`: writes the ONNX file of the student under pretrained/ beside its parameters.

It is kept there so that `ddgrasp play` needs no JAX; a test says when it is not its student's any more.
"""

from pathlib import Path

from ddgrasp import artifacts
from ddgrasp.files import atomic_write_bytes
from ddgrasp.shipped import PRETRAINED
from export.stage import POLICY_FILE, export_policy, load_student


def write(student: Path = PRETRAINED / "student") -> Path:
    """Exports the finished student stage in `student` into its own folder; UserError if there is none."""
    artifact = artifacts.read_artifact(student)
    config = artifacts.config_from_json(artifact.manifest.config)
    atomic_write_bytes(student / POLICY_FILE, export_policy(config, load_student(student), artifact.hash))
    return student / POLICY_FILE


if __name__ == "__main__":
    print(write())
