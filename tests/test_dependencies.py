"""What fitctl imports is what its package requires."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).parent.parent
_NAME = re.compile(r"[\w.-]+")


def imported():
    """Top-level modules of others that fitctl's code names."""
    for path in (ROOT / "fitctl").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                yield from (alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                yield node.module.partition(".")[0]


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_import_is_a_dependency_of_its_own_and_not_only_one_of_a_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = (line for group in project["optional-dependencies"].values() for line in group)
    required = {normal(_NAME.match(line)[0]) for line in [*project["dependencies"], *extras]}
    distributions = packages_distributions()
    foreign = set(imported()) - sys.stdlib_module_names - {"fitctl"}
    missing = {
        module
        for module in foreign
        if required.isdisjoint(normal(name) for name in distributions.get(module, [module]))
    }
    assert missing == set()
