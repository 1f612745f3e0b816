"""Runs algorithms through an agent that shares no files with the controller: everything travels over a socket."""
