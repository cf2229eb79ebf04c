"""Report of the changes that registration has made."""
