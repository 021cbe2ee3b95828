"""Packages with their records, reports and signatures."""
