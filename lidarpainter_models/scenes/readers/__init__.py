"""One module per dataset; a dataset's oddities end here."""
