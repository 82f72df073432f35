"""Networks trained in simulation on real frames: experiments, fine-tuning, gaps."""
