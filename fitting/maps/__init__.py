"""One material per texel, from photographs of one view under many lights."""
