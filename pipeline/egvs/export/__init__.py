"""A finished run as files for GIS, spreadsheets and print."""
