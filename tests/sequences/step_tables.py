"""The tables of docs/sequences.md, made from the steps' own fields; run it to print them."""

from typing import Literal, get_args, get_origin

from documents import table

from fitctl.sequences.reading import STEPS
from fitctl.sequences.steps import Step

COMMON = set(Step.model_fields)


def default(field):
    if field.is_required():
        return "required"
    if field.default in {None, ""}:
        return ""
    return f"{field.default:g}" if isinstance(field.default, int | float) else f"`{field.default}`"


def meaning(field):
    choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
    return ": ".join([field.description, *([f"`{'`, `'.join(choices)}`"] if choices else [])])


def common_keys():
    rows = [
        [f"`{name}`", field.description]
        for name, field in Step.model_fields.items()
        if name != "step"
    ]
    return table(["key", "meaning"], rows)


def step_keys():
    rows = []
    for name, kind in STEPS.items():
        fields = kind.model_fields
        limits = f"{fields['timeout_s'].default:g} s, {fields['attempts'].default}"
        rows.append([f"**`{name}`**", limits, " ".join(kind.__doc__.split())])
        rows += [
            [f"`{key}`", default(field), meaning(field)]
            for key, field in fields.items()
            if key not in COMMON
        ]
    return table(["step and its keys", "`timeout_s`, `attempts`; key's default", "meaning"], rows)


if __name__ == "__main__":
    print(common_keys(), step_keys(), sep="\n\n")
