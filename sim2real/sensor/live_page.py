"""The live sensor in a browser: tactile image, pins, and what is felt."""

from tactip_twin.sim.view.viser_utils import LOCAL, grey, serve, stop


class CameraPage:
    """A page that shows Readings as they come."""

    def __init__(self, title, host=LOCAL, port=8080):
        """title: str. host: str. port: int, or the next that is free. Raises TactipError where it cannot be served."""
        self._server = serve(host, port)
        self.address = f"http://{host}:{self._server.get_port()}"
        """Where the page is."""
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._server.gui.set_panel_label(title)
        self._told, self._image = self._server.gui.add_markdown(""), None

    def show(self, reading, rate):
        """Show a camera.Reading. rate: float, frames/s."""
        lines = [f"frame {reading.number}, {reading.pins} pins, {rate:.1f} frames/s"]
        if reading.felt:
            rows = [f"| {name} | {value:.2f} {'°' if '_R' in name else 'mm'} |" for name, value in reading.felt.items()]
            lines.append("\n".join(["| | felt |", "|---|---|", *rows]))
        lines += [f"**{reading.fault}**"] if reading.fault else []
        with self._server.atomic():
            self._told.content = "\n\n".join(lines)
            if self._image is None:
                self._image = self._server.gui.add_image(grey(reading.image), label="felt", format="png")
            else:
                self._image.image = grey(reading.image)

    def close(self):
        """Stop serving."""
        stop(self._server)
