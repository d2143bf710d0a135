"""Range finders."""
