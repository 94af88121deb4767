"""`python -m export.pretrained`: writes the ONNX file of the student under pretrained/ beside its parameters.

It is kept there so that `ddgrasp play` needs no JAX; a test says when it is not its student's any more.
"""

from pathlib import Path

from ddgrasp import artifacts
from ddgrasp.files import atomic_write_bytes
from ddgrasp.policy_metadata import POLICY_FILE
from ddgrasp.progress import Progress
from ddgrasp.shipped import PRETRAINED
from export.stage import export_policy, measure


def write(student: Path = PRETRAINED / "student") -> Path:
    """Exports the finished student stage in `student` into its own folder.

    UserError if there is none, or the file does not do what the student does.
    """
    from student_jax.policy import load

    config, params = load(student)
    model = export_policy(config, params, artifacts.read_artifact(student).hash)
    measure(config, params, model, None, Progress(name="export"))
    atomic_write_bytes(student / POLICY_FILE, model)
    return student / POLICY_FILE


if __name__ == "__main__":
    print(write())
