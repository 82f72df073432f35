"""The live sensor in a browser: tactile image, number of pins, and the predicted pose."""

from tactip_twin.sim.view.viser_utils import LOCAL, grey, serve, stop
from tactip_twin.sim2real.sensor.live import Reading


class CameraPage:
    """A page that shows each Reading."""

    def __init__(self, title: str, host: str = LOCAL, port: int = 8080) -> None:
        """Start serving the page.

        Args:
            title: Title of the page.
            host: Address at which it is served.
            port: Its port; if it is taken, the next free one.

        Raises:
            TactipError: If it cannot be served.
        """
        self._server = serve(host, port)
        self.address = f"http://{host}:{self._server.get_port()}"
        """Address of the page."""
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._server.gui.set_panel_label(title)
        self._text, self._image = self._server.gui.add_markdown(""), None

    def show(self, reading: Reading, rate: float) -> None:
        """Show a Reading, and the rate, frames per second."""
        lines = [f"frame {reading.number}, {reading.pins} pins, {rate:.1f} frames/s"]
        if reading.predicted:
            rows = [
                f"| {name} | {_cell(name, value, reading.deviations.get(name))} |"
                for name, value in reading.predicted.items()
            ]
            lines.append("\n".join(["| | predicted |", "|---|---|", *rows]))
        lines += [f"**{reading.fault}**"] if reading.fault else []
        with self._server.atomic():
            self._text.content = "\n\n".join(lines)
            if self._image is None:
                self._image = self._server.gui.add_image(grey(reading.image), label="tactile image", format="png")
            else:
                self._image.image = grey(reading.image)

    def close(self) -> None:
        """Stop serving."""
        stop(self._server)


def _cell(name: str, value: float, deviation: float | None) -> str:
    """Return a value with its unit, and with its standard deviation if there is one."""
    unit = "°" if "_R" in name or name.endswith("_deg") else "N" if name.endswith("_N") else "mm"
    unit = "" if name in ("slip_fraction", "contact") else f" {unit}"
    return f"{value:.2f}{unit}" if deviation is None else f"{value:.2f} ± {deviation:.2f}{unit}"
