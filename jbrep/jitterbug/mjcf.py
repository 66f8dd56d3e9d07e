"""The text of the Jitterbug's model."""

from importlib import resources


def read_xml() -> str:
    """The MJCF text of the published robot."""
    return resources.files(__package__).joinpath("jitterbug.xml").read_text()
