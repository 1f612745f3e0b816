"""Files from the net: resumable downloads, safe unpacking, checks of addresses."""
