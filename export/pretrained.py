"""The student under pretrained/ as an ONNX file, exported when it is first asked for."""

from pathlib import Path

from ddgrasp import artifacts
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes, atomic_write_text, user_cache
from export.stage import POLICY_FILE, export_policy, load_student

STUDENT = Path(__file__).parents[1] / "pretrained" / "student"


def pretrained_policy(student: Path = STUDENT) -> Path:
    """Path of the ONNX file of the student stage in `student`; its folder has the manifest, so that the
    configuration is found beside it. Kept in the user's caches, one folder for each student.

    Raises UserError if there is no student.
    """
    if not artifacts.is_finished(student):
        raise UserError(f"{student} holds no student: give --policy, or start in a clone of the project.")
    artifact = artifacts.read_artifact(student)
    folder = user_cache("pretrained") / artifact.hash
    policy = folder / POLICY_FILE
    if not policy.exists():
        config = artifacts.config_from_json(artifact.manifest.config)
        atomic_write_text(folder / artifacts.MANIFEST, (student / artifacts.MANIFEST).read_text())
        atomic_write_bytes(policy, export_policy(config, load_student(student), artifact.hash))
    return policy
