"""Templates of the pages; all text that comes from outside is escaped."""

import jinja2

from l3r.version import __version__


def render(template: str, **values: object) -> str:
    """Fill a template of this folder.

    Args:
        template: Its file name.
        values: What it names; one that is missing is an error.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("data_prep.pages", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(version=__version__, **values)
