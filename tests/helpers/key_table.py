from msgspec import inspect

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
        f"| `{f'{of}.' if of else ''}{key.name}` | {allowed(key.kind)} | {key.default_shown} "
        f"| {key.help} |"
        for key in keys_of(kind)
        if key.name not in without
    ]
    return "\n".join(["| key | type | default | |", "|---|---|---|---|", *rows])


def allowed(node: inspect.Type) -> str:
    """A type with its limits: int >= 1, <= 10,000."""
    match node:
        case inspect.Metadata(type=inner):
            return allowed(inner)
        case inspect.UnionType(types=types):
            some = (each for each in types if not isinstance(each, inspect.NoneType))
            return " or ".join(dict.fromkeys(map(allowed, some)))
        case inspect.LiteralType(values=values):
            return ", ".join(str(each) for each in values if each)
        case inspect.TupleType(item_types=items):
            return f"list of {', '.join(map(allowed, items))}"
        case inspect.CollectionType(item_type=item):
            return f"list of {allowed(item)}"
        case inspect.StructType(array_like=False) | inspect.DictType():
            return "table"
        case inspect.StructType(fields=fields):
            return f"list of {', '.join(each.encode_name for each in fields)}"
        case (
            inspect.IntType(gt=gt, ge=ge, lt=lt, le=le)
            | inspect.FloatType(gt=gt, ge=ge, lt=lt, le=le)
        ):
            is_int = isinstance(node, inspect.IntType)
            limits = {">": gt, ">=": ge, "<": lt, "<=": le}
            told = [
                f"{sign} {limit:,}" if is_int else f"{sign} {limit:g}"
                for sign, limit in limits.items()
                if limit is not None and abs(limit) < 1e300
            ]
            return " ".join(["int" if is_int else "float", ", ".join(told)]).strip()
        case inspect.BoolType():
            return "bool"
    return "text"
