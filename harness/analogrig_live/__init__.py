"""Live bench: a rig and a device that are operated by hand while they run, and the page that shows them.

hand -> commands -> session -> rig, device -> blocks -> ring -> frames -> clients
"""
