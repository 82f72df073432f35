"""A digital twin of the TacTip, a soft optical fingertip."""
