"""What a finished run found, in the files of other programs: any map, a spreadsheet, paper."""
