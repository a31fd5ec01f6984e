//! Makes tests from a table of commands: every driver on every row. The columns: name, inputs, prefixes of written paths, the
//! message when everything is done already, arguments.

macro_rules! rows {
    ($($name:ident: $prepare:expr, $writes:expr, $again:expr, $arguments:expr;)*) => {
        $(mod $name {
            use super::*;

            pub const ROW: crate::driver::Row = crate::driver::Row {
                name: stringify!($name),
                prepare: $prepare,
                arguments: $arguments,
                writes: &$writes,
                again: $again,
            };

            #[test]
            fn is_killed_and_restarted() {
                if !crate::driver::is_left_out(&ROW) {
                    crate::kill::killed_and_restarted(&ROW);
                }
            }

            #[test]
            fn runs_twice_at_once() {
                if !crate::driver::is_left_out(&ROW) {
                    crate::two::two_at_once(&ROW);
                }
            }

            #[test]
            fn fills_a_disk() {
                if !crate::driver::is_left_out(&ROW) {
                    crate::space::small_disk(&ROW);
                }
            }

            #[test]
            fn may_only_read() {
                if !crate::driver::is_left_out(&ROW) {
                    crate::unwritable::read_only(&ROW);
                }
            }

            #[test]
            fn has_no_standard_output() {
                if !crate::driver::is_left_out(&ROW) {
                    crate::unwritable::no_standard_output(&ROW);
                }
            }
        })*

        /// All rows.
        #[allow(dead_code)]
        pub const ROWS: &[crate::driver::Row] = &[$($name::ROW),*];
    };
}
