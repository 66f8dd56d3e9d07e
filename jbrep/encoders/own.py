"""Users' torch modules as encoders that a file can hold."""

import re
from dataclasses import replace

from jbrep.encoders.base import BaseEncoder, OwnEncoder
from jbrep.encoders.encoder import Encoder
from jbrep.errors import InputError


def as_file(encoder: BaseEncoder) -> BaseEncoder:
    """The encoder that a file can hold, where a user's own is a module with such layers.

    Its header has no versions: equal layers are the same encoder, whatever converted them.

    Returns:
        The same encoder where it isn't a user's own, or can't be converted.
    """
    if not isinstance(encoder, OwnEncoder) or not encoder.is_module:
        return encoder
    name = re.sub("[^a-z0-9]+", "-", encoder.name.lower()).strip("-") or "own"
    try:
        converted = Encoder.from_torch(encoder.given, encoder.task, name=name)
    except InputError:
        return encoder
    return replace(converted, header={**converted.header, "versions": {}})
