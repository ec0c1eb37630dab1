"""Campaigns: logs x model structures x seeds, over cores or machines."""
