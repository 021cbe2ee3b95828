"""HTML of the studio page, from the Jinja templates in `templates/`, with autoescaping."""

from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined

from flows.formatting.numbers import format_duration, format_size
from flows.packages.acceptance import format_bounds, format_value


def render(template: str, **values: object) -> str:
    """Fill a template of `templates/`."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("flows.studio"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "size": format_size,
        "duration": format_duration,
        "value": format_value,
        "bounds": format_bounds,
    }
    return environment
