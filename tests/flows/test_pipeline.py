"""Parameters of the flows: checked in full, described in brief."""

import json
from pathlib import Path
from typing import Any

import pytest
from conversions import job
from prefect import Flow
from prefect.exceptions import ParameterTypeError

from flows import pipeline

FLOWS = [pipeline.image_to_4d, pipeline.video_to_4d, pipeline.text_to_4d, pipeline.motions]


@pytest.mark.parametrize("flow", FLOWS)
def test_jobs_are_validated_by_every_flow(flow: Flow[..., Any], tmp_path: Path) -> None:
    wanted = job("a cat", tmp_path)
    assert flow.validate_parameters({"job": wanted})["job"] == wanted
    assert flow.validate_parameters({"job": wanted.model_dump(mode="json")})["job"] == wanted
    for other in ({}, "a cat", {**wanted.model_dump(mode="json"), "seed": "many"}):
        with pytest.raises(ParameterTypeError):
            flow.validate_parameters({"job": other})


@pytest.mark.parametrize("flow", FLOWS)
def test_the_schema_of_a_job_is_not_built_for_every_flow(flow: Flow[..., Any]) -> None:
    assert len(json.dumps(flow.parameters.model_dump())) < 2000
