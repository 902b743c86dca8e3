"""What fitctl imports is what its package requires."""

import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).parent.parent
# To parse every file takes seconds. An `import` names one module, not several (ruff, E401).
_IMPORT = re.compile(r"^ *(?:import (\w+)|from (\w+)[\w.]* import )", re.MULTILINE)
_NAME = re.compile(r"[\w.-]+")


def imported():
    """Top-level modules of others that fitctl's code names."""
    for path in (ROOT / "fitctl").rglob("*.py"):
        for module, package in _IMPORT.findall(path.read_text()):
            yield module or package


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
