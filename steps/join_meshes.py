"""Step that joins the meshes of single frames, extracted in parts, into one artifact."""

import zipfile

from dg4d_lib.errors import BadInput
from steps.artifacts.media import write_zip
from steps.runtime.job import Job, StepReport


def run(job: Job) -> StepReport:
    """Write the entries of all parts, sorted by name; the order of the parts does not matter.

    Raises:
        BadInput: two parts have different meshes of one frame.
    """
    entries: dict[str, bytes] = {}
    for path in job.inputs.values():
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                content = archive.read(name)
                if entries.setdefault(name, content) != content:
                    raise BadInput(f"Two parts have different entries {name}; extract the meshes again.")
    write_zip(job.outputs["meshes"], sorted(entries.items()))
    return StepReport()
