"""Campaigns: logs x model structures x seeds, over cores or machines."""

from sysid.campaigns.campaign import Campaign, Outcome, Run, Spread, campaign, combinations

__all__ = ["Campaign", "Outcome", "Run", "Spread", "campaign", "combinations"]
