"""Plug-ins for other programs; not part of the installed package."""
