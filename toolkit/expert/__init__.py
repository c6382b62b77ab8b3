"""The source's expert: trained from demonstrations, and kept by name."""
