"""Writers of the formats that maps, spreadsheets and rasters are exchanged in."""
