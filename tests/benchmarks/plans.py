"""Plans of the swarm that a test writes by hand."""

from benchmarks.swarm.happenings import Order, Plan


def plan(*happenings, duration_s=8.0, rig="fit-mock.toml", settings=()):
    """A plan of these happenings."""
    return Plan(
        seed=1,
        rig=rig,
        settings=list(settings),
        duration_s=duration_s,
        happenings=sorted(happenings, key=lambda happening: happening.at_s),
    )


def gives(at_s, command, who="ada"):
    """An operator sends a command, or the one that leads on."""
    return Order(at_s=at_s, who=who, command=command)
