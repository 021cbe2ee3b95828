"""Tasks that publish the package in the output folder and record the version in the store."""

from pathlib import Path

from prefect import task
from prefect.cache_policies import NO_CACHE

from flows import home
from flows.engine import versions
from flows.engine.events import remark_on_output
from flows.inputs.conversion_job import ConversionJob
from flows.packages.credentials import configured_signer
from flows.packages.flow_result import FlowResult
from flows.packages.report import deliver
from steps.contract import StepResult


@task(name="publish", task_run_name="publish: {job.item}", cache_policy=NO_CACHE, persist_result=False)
def publish(package: StepResult, verdict: StepResult, job: ConversionJob, result: FlowResult, folder: Path) -> None:
    """Write the reports, sign the files if a key is configured, and put the package into the output folder.

    Args:
        package: result of `pack_asset`.
        verdict: result of `check_asset`.
        job: request of the conversion.
        result: result of the conversion.
        folder: output folder.

    Raises:
        BadInput: the folder cannot be written, the disk is full, or the key cannot sign; the folder is as it was.
        BackendUnavailable: a key is configured, and signing is not installed.
    """
    deliver(job, result, folder, configured_signer(), remark_on_output(job.item))


@task(name="keep_version", task_run_name="keep_version: {job.item}", cache_policy=NO_CACHE, persist_result=False)
def keep_version(job: ConversionJob, result: FlowResult) -> None:
    """Record the version in the store; `dg4d store gc` keeps its artifacts from now on.

    Raises:
        ArtifactMissing: an artifact was removed meanwhile; the same job again makes it again.
        StoreUnreachable: the store does not answer.
    """
    versions.keep_version(home.store(), job, result)
