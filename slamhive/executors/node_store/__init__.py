"""Data gets to a node once, and results come back, by HTTP. For engines whose nodes share no file system with us.

``on_node`` is what nodes execute; it needs the standard library alone. The other modules are the controller's.
"""
