"""tactip bench: measurements, which are part of the repository but not of the installed package."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from tactip_twin.commands._parsing import Command, Entry, parse_options, parse_subcommand
from tactip_twin.tactip_model.errors import TactipError

if TYPE_CHECKING:
    from tactip_twin.benchmarks.measurements import Measurement


@dataclass(frozen=True)
class Bench(Command):
    """Measure errors, costs and limits of simulation, networks and servo."""

    measurement: "Measurement"
    """The measurement."""
    options: Any
    """Its options."""

    @classmethod
    def parse(cls, arguments: Sequence[str], prog: str) -> Command:
        """Parse the options of the named measurement. Raises TactipError if measurements are not installed."""
        try:
            measurements = import_module("tactip_twin.benchmarks.measurements").MEASUREMENTS
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith("tactip_twin.benchmarks"):
                raise
            raise TactipError(
                "the measurements are not part of the installed package: clone the repository and run `make setup` in it"
            ) from error
        table = {name: Entry(one.options.__doc__ or "", cls._parser(one)) for name, one in measurements.items()}
        return parse_subcommand(table, arguments, prog, (cls.__doc__ or "").splitlines()[0])

    @classmethod
    def _parser(cls, measurement: "Measurement") -> Callable[[Sequence[str], str], Command]:
        """Return the parser of a measurement's options."""
        return lambda arguments, prog: cls(measurement, parse_options(measurement.options, arguments, prog))

    def run(self) -> int:
        result = import_module(self.measurement.module).run(self.options)
        if self.measurement.page:
            print(f"{self.options.out / self.measurement.page} written")
        return 1 if (result or {}).get("counts", {}).get("wrong") else 0
