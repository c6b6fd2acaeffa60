//! Dictionaries of the markers on ChArUco boards.

use calib_targets_charuco::{Dictionary, resolve_dictionary};

/// Returns a dictionary by its name.
pub(crate) fn dictionary(name: &str) -> Result<Dictionary, String> {
    resolve_dictionary(name).ok_or_else(|| {
        format!(
            "dictionary is {name:?}, which is unknown; expected a name of OpenCV's, such as DICT_4X4_50 or DICT_5X5_100"
        )
    })
}

/// Checks that a dictionary has enough markers.
pub(crate) fn check_dictionary(name: &str, needed: usize) -> Result<(), String> {
    let has = dictionary(name)?.codes().len();
    if has < needed {
        return Err(format!("dictionary {name} has {has} markers, but the board needs {needed}; take a larger one"));
    }
    Ok(())
}
