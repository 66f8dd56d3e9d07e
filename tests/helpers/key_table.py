from jbrep.records.words import must_be

from jbrep.records.keys import keys_of
from jbrep.records.record import Record


def key_table(kind: type[Record], *, of: str = "", without: tuple[str, ...] = ()) -> str:
    """The keys as a table in Markdown, as the docs have it.

    Args:
        kind: the record's class.
        of: the key that the record stands under: "data" for data.steps.
        without: names of keys to leave out.
    """
    rows = [
        f"| `{f'{of}.' if of else ''}{key.name}` | {must_be(key.kind)} | {key.default_shown} "
        f"| {key.help} |"
        for key in keys_of(kind)
        if key.name not in without
    ]
    return "\n".join(["| key | must be | default | |", "|---|---|---|---|", *rows])
