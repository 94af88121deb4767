"""Stage `deploy`: the exported student on the development rig at 10 Hz."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ddgrasp import contract
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.config_hash import config_hashes
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes, to_json
from ddgrasp.job import Job
from ddgrasp.policy_metadata import POLICY_FILE
from ddgrasp.progress import Progress
from ddgrasp.trained import trained_objects
from deploy.timing import Timings
from deploy.trial_log import CONFIG_HASH, TrialLog
from deploy.trials import RULES, TrialResult, keep_results, lasting, plan, run_trials, tried
from rig.film import Film, contact_sheet

STAGE = "deploy"
TRIALS_FILE = "trials.jsonl"
_KINDS = (("seen", True), ("unseen", False))


def run(job: Job) -> Artifact:
    """Run the trials that are not in trials.jsonl yet, then write the manifest."""
    config, directory, progress = job.config, job.directory, job.progress
    policy_path = job.parents["export"].directory / POLICY_FILE
    log = TrialLog(directory / TRIALS_FILE, _header(config, policy_path))
    rig = tried(config)
    trials = plan(rig)
    with progress.task("trials", len(trials)) as task:
        task.start_at(len(log.results))

        def keep(result: TrialResult, film: Film) -> None:
            log.append(result)
            _keep_film(directory, result, film, progress)
            done = [r for r in log.results.values() if not r.realtime]
            task.advance(success=sum(r.success for r in done) / max(len(done), 1))

        simulated = lasting(rig, contract.TRIAL_S), config.deploy.workers
        # Latency is measured with the machine to itself, hence one process on the real clock.
        for batch, (settings, workers) in ((False, simulated), (True, (rig, 1))):
            todo = [t for t in trials if t.realtime is batch and (t.index, t.realtime) not in log.results]
            keep_results(run_trials(settings, policy_path, todo, workers), keep)
    results = [log.results[(trial.index, trial.realtime)] for trial in trials]
    return job.finish(metrics(results, trained_objects(to_json(config), "student")))


def metrics(results: Sequence[TrialResult], trained: Sequence[str]) -> dict[str, Any]:
    """What the report shows: success on the simulated clock, objects `trained` on and others apart, and time
    keeping on the real one."""
    simulated = [r for r in results if not r.realtime]
    real = [r for r in results if r.realtime]
    names = sorted({r.object_name for r in simulated})
    apart = {kind: [r for r in simulated if (r.object_name in trained) == seen] for kind, seen in _KINDS}
    rows = [{"object": name, **_success(r for r in simulated if r.object_name == name)} for name in names]
    return {
        "student_rig": {
            "success": _success(simulated),
            **{kind: _success(some) for kind, some in apart.items() if some},
            "per_object": {row["object"]: {k: row[k] for k in ("successes", "n")} for row in rows},
        },
        "holds": sum(r.holds for r in results),
        "safety": _total(r.safety for r in simulated),
        "realtime_trials": _success(real),
        **_timings(real or simulated).summary(contract.CONTROL_DT_S),
    }


def _header(config: Config, policy_path: Path) -> dict[str, Any]:
    if not policy_path.is_file():
        raise UserError(
            f"{policy_path}: no such file; delete {policy_path.parent}, then run `ddgrasp export` again."
        )
    return {
        "policy_sha256": hashlib.sha256(policy_path.read_bytes()).hexdigest(),
        CONFIG_HASH: config_hashes(config, STAGE),
        "trial_s": contract.TRIAL_S,
        "objects": list(tried(config).world.objects),
    } | RULES


def _keep_film(directory: Path, result: TrialResult, film: Film, progress: Progress) -> None:
    """The first success and the first failure become pictures."""
    name = "rig_success" if result.success else "rig_failure"
    path = directory / f"{name}.png"
    if path.exists() or not film.steps:
        return
    outcome = "success" if result.success else "failure"
    title = f"trial {result.index}, {result.object_name}: {outcome}"
    atomic_write_bytes(path, contact_sheet(film, title))
    progress.picture(name, rgb=film.rgb, depth=film.depth_mm)


def _success(results: Iterable[TrialResult]) -> dict[str, int]:
    return contract.counted([result.success for result in results])


def _total(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    total: Counter[str] = Counter()
    for count in counts:
        total.update(count)
    return dict(total)


def _timings(results: Iterable[TrialResult]) -> Timings:
    total = Timings()
    for r in results:
        total.extend(r.timings)
    return total
