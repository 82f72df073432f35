"""tactip export: a network for other software."""

from dataclasses import dataclass
from pathlib import Path

from tactip_twin.commands._parsing import Command
from tactip_twin.commands._progress import DelayedStatus


@dataclass(frozen=True)
class Export(Command):
    """Write a network as an ONNX file that takes tactile images and returns estimates in mm, degrees and N. Needs the
    extra `onnx`."""

    example = "tactip export --model surface-tactip-127 --onnx surface.onnx"

    model: Path
    """Shipped network, or folder of a training."""
    onnx: Path
    """ONNX file to write; it is run by onnxruntime first, and compared with torch."""

    def run(self) -> int:
        with DelayedStatus("reading the network"):
            from tactip_twin.learning.model import load_network
            from tactip_twin.learning.onnx_export import export_onnx, output_names

            model = load_network(self.model)
        found = export_onnx(model, self.onnx)
        print(f"{self.onnx} written; it differs from torch by at most {found:.1g} of an output")
        print(f"input: images (n, {model.size}, {model.size}) uint8; outputs: {', '.join(output_names(model))}")
        return 0
