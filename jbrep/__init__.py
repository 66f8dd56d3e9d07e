"""jbrep: reduced-order representations of an underactuated robot, and what they do to learning.

Importing it registers the Jitterbug's environments with Gymnasium; nothing heavy is loaded until
it is used.
"""

from types import ModuleType

import wrapt


def _register(_gymnasium: ModuleType) -> None:
    from jbrep.jitterbug.registration import register

    register()


wrapt.register_post_import_hook(_register, "gymnasium")
