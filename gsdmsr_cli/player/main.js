// Where the script begins: on the page, and again in the worker, which has no document.

import { show } from "./page.js";
import { work } from "./worker.js";

if (typeof document === "undefined") work();
else show(document.currentScript.textContent);
