"""Reading what users give and writing what they get; every user error lives here."""
