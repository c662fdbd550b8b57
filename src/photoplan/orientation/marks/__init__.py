"""Fiducial marks and targets, found and measured in scans."""
